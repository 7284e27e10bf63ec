"""A forest for known parts: trees on a descriptor of metric size and shape.

It trains in seconds without PyTorch, and predicts without scikit-learn.
"""

from qs3.forest.descriptor import describe as describe
from qs3.forest.descriptor import describe_varied as describe_varied
from qs3.forest.forest import Forest as Forest
from qs3.forest.forest import fit_forest as fit_forest
