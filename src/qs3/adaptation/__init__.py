"""Methods of adaptation, the rules that select pseudo labels, and calibrated confidence.

Names and rules need no PyTorch; it loads when a method is first requested.
"""

from typing import TYPE_CHECKING

from qs3.lazy import loader

if TYPE_CHECKING:
    from qs3.adaptation.factory import create_method as create_method
    from qs3.adaptation.factory import list_methods as list_methods
    from qs3.adaptation.factory import method_class as method_class
    from qs3.adaptation.factory import method_name as method_name
    from qs3.adaptation.method import Batch as Batch
    from qs3.adaptation.method import Method as Method
    from qs3.adaptation.method import PseudoLabelled as PseudoLabelled
    from qs3.adaptation.method import SourceOnly as SourceOnly
    from qs3.adaptation.method import cross_entropy as cross_entropy
    from qs3.adaptation.selection import SingleClassWarning as SingleClassWarning
    from qs3.adaptation.selection import select_confident as select_confident
    from qs3.adaptation.selection import select_quasi_balanced as select_quasi_balanced

__getattr__ = loader(__name__)
