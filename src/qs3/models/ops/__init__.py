"""Point operations in plain PyTorch, on CPU and CUDA, without compiled extensions.

Convention:
    Clouds are batch-first, [b n c]. Indices count within the own cloud, and a point is a neighbour
    of itself. Every operation gives the same bits at each call. None makes a tensor larger than its
    inputs, its result or a block of fixed size, whichever is largest.
"""

from qs3.models.ops.gathering import flat_indices as flat_indices
from qs3.models.ops.gathering import gather_points as gather_points
from qs3.models.ops.gathering import neighbour_max as neighbour_max
from qs3.models.ops.gathering import neighbour_sum as neighbour_sum
from qs3.models.ops.gathering import scatter_points as scatter_points
from qs3.models.ops.neighbours import ball_query as ball_query
from qs3.models.ops.neighbours import knn as knn
from qs3.models.ops.neighbours import three_nn_interpolate as three_nn_interpolate
from qs3.models.ops.sampling import farthest_point_sampling as farthest_point_sampling
from qs3.models.ops.sampling import nested_samples as nested_samples
