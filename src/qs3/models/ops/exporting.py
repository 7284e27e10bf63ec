"""Forms of the operations for graphs that are made once and run elsewhere.

An exported graph must hold for any number of clouds, so that blocks of them, which save memory
here, are not made there; and a loop over points must stay a loop, or it fills the graph.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def is_exporting() -> bool:
    """Tell whether a graph is made for elsewhere; older PyTorch tells of any tracing alone.

    Example:
        >>> is_exporting()
        False
    """
    return getattr(torch.compiler, "is_exporting", torch.compiler.is_compiling)()


def sample_in_a_loop(
    planes: Float[Tensor, "3 b n"],
    chosen: Int[Tensor, "b m"],
    end: Int[Tensor, ""],
    repeat: bool = False,
) -> Int[Tensor, "b m"]:
    """Sample farthest points by one loop in the graph, whose last steps may be left out.

    Args:
        planes: x, y and z of the clouds.
        chosen: Indices to begin with; the first of each cloud is where sampling starts.
        end: Where sampling ends; ``chosen`` stays as it is from there on.
        repeat: Whether a point may be chosen again, once all others lie on chosen ones too.

    Example:
        >>> planes = torch.tensor([[[0.0, 1.0, 9.0]], [[0.0, 0, 0]], [[0.0, 0, 0]]])
        >>> sample_in_a_loop(planes, torch.zeros(1, 3, dtype=torch.int64), torch.tensor(2)).tolist()
        [[0, 2, 0]]
    """
    # The public wrapper would first compile both functions, which a debugger's or a checker's
    # wrapping of them breaks; the operation itself takes them as they are, with all they read.
    from torch._higher_order_ops.while_loop import while_loop_op

    def goes_on(step, chosen, nearest, planes, end):
        return step < end

    def choose(step, chosen, nearest, planes, end):
        newest = chosen.index_select(1, (step - 1).view(1))
        position = planes.gather(2, newest.expand(3, -1, 1))
        # One addition after the other, as elsewhere, for the same bits.
        x, y, z = (planes - position).square().unbind()
        nearest = torch.minimum(nearest, x + y + z)
        if not repeat:
            nearest = nearest.scatter(1, newest, -1.0)
        farthest = nearest.argmax(dim=1, keepdim=True)
        column = torch.arange(chosen.shape[1], device=chosen.device)
        return step + 1, torch.where(column == step, farthest, chosen), nearest

    start = torch.ones((), dtype=torch.int64, device=chosen.device)
    nearest = torch.full_like(planes[0], torch.inf)
    carried: tuple = (start, chosen, nearest)
    return while_loop_op(goes_on, choose, carried, (planes, end))[1]
