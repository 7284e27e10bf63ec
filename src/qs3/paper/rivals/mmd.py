"""Maximum mean discrepancy of two samples (Gretton et al., JMLR 2012)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.errors import InputError


def mmd(
    x: Float[Tensor, "b c"], y: Float[Tensor, "m c"], bandwidths: Sequence[float]
) -> Float[Tensor, ""]:
    """Squared maximum mean discrepancy with a sum of Gaussian kernels, biased.

    k(u, v) = Σ_σ exp(−|u − v|² / 2σ²), and MMD² = mean k(x, x') + mean k(y, y') − 2 mean k(x, y)
    (Gretton et al., JMLR 2012, eq. 5), which is never negative. ``bandwidths`` are σ of each
    kernel, in the unit of the features.

    Example:
        >>> one, other = torch.zeros(2, 1), torch.full((2, 1), 2.0)
        >>> round(float(mmd(one, other, [1.0])), 4)  # 2 − 2 exp(−2)
        1.7293
    """
    if not (len(x) and len(y)):
        raise InputError(f"mmd needs samples of 1 or more, not {len(x)} and {len(y)}")
    with torch.autocast(x.device.type, enabled=False):
        rows = torch.cat([x.double(), y.double()])
        # By differences, as |u|² + |v|² − 2u·v loses half of the digits.
        squared = torch.cdist(rows, rows, compute_mode="donot_use_mm_for_euclid_dist").square()
    kernel = torch.zeros_like(squared)
    for sigma in bandwidths:
        kernel = kernel + torch.exp(squared / (-2 * sigma**2))
    b = len(x)
    within = kernel[:b, :b].mean() + kernel[b:, b:].mean()
    dtype = torch.promote_types(x.dtype, torch.float32)
    return (within - 2 * kernel[:b, b:].mean()).to(dtype)
