"""What a user does in one call: from CAD and unlabelled scans to a classifier and its answers."""

from typing import TYPE_CHECKING

from qs3.lazy import loader

if TYPE_CHECKING:
    from qs3.workflow.adapt import Adapted as Adapted
    from qs3.workflow.adapt import Step as Step
    from qs3.workflow.adapt import steps as steps
    from qs3.workflow.options import AdaptOptions as AdaptOptions

__getattr__ = loader(__name__)
