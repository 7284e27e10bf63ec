"""Alignment of visible points with a scan, both ways, by Gauss-Newton steps.

A point of the part stands for a small disc: a pair costs its distance along the normal, and across
it only what exceeds the spacing of the points (between point-to-plane and point-to-point ICP; Chen
and Medioni, 1992; Segal et al., Generalized-ICP, 2009). Pairs are weighted by the kernel of Geman
and McClure, so that strays do not pull.

A camera measures depth less well than outlines: what stereo adds to noise from point to point is
alike over a part, and of a size that no plane through neighbours shows. So all distances are
measured in a space that is flattened along the line of sight, by as many times as depth is less
certain.
"""

import numpy as np
from jaxtyping import Float, Float32

from qs3.points.compiled import compiled

HELD = 0.5
"""Weight of the height of a known table against the pairs of points."""


@compiled
def columns_of(points, normals):
    """Return points and normals as six rows, which loops over points read in order."""
    out = np.empty((6, len(points)))
    for i in range(len(points)):
        for k in range(3):
            out[k, i], out[3 + k, i] = points[i, k], normals[i, k]
    return out


@compiled
def placed(columns, turn, shift, sight, deep):
    """Return twelve rows: posed points, their normals over the stretch, and both flattened.

    The stretch is by how many times flattening shortens a distance along the normal. Each loop
    writes one row: LLVM makes vectors of it, and none of a loop over all rows.
    """
    count = columns.shape[1]
    out, far, stretch = np.empty((12, count)), np.empty(count), np.empty(count)
    for k in range(3):
        a, b, c, d, row = turn[k, 0], turn[k, 1], turn[k, 2], shift[k], out[k]
        for i in range(count):
            row[i] = a * columns[0, i] + b * columns[1, i] + c * columns[2, i] + d
        row = out[3 + k]
        for i in range(count):
            row[i] = a * columns[3, i] + b * columns[4, i] + c * columns[5, i]
    x, y, z, u, v, w = out[0], out[1], out[2], out[3], out[4], out[5]
    a, b, c = sight[0], sight[1], sight[2]
    for i in range(count):
        far[i] = (1 / deep - 1) * (a * x[i] + b * y[i] + c * z[i])
    for k in range(3):
        d, row, posed = sight[k], out[6 + k], out[k]
        for i in range(count):
            row[i] = posed[i] + far[i] * d
    facing = far
    for i in range(count):
        facing[i] = a * u[i] + b * v[i] + c * w[i]
    for i in range(count):
        stretch[i] = np.sqrt(1 + (deep * deep - 1) * facing[i] * facing[i])
    for k in range(3):
        d, row, posed = sight[k], out[9 + k], out[3 + k]
        for i in range(count):
            row[i] = (posed[i] + (deep - 1) * facing[i] * d) / stretch[i]
        for i in range(count):
            posed[i] /= stretch[i]
    return out


_LANES = 16
"""Numbers of single precision in the widest vector."""
_NOWHERE = np.float32(1e18)


@compiled
def flat_of(scan):
    """Return the flattened rows of a placed scan as `pair` takes them.

    They are as long as whole vectors: a loop would do the last few points one by one. What fills
    them is farther than any point.
    """
    count = scan.shape[1]
    flat = np.full((6, -(-count // _LANES) * _LANES), _NOWHERE)
    for k in range(6):
        for i in range(count):
            flat[k, i] = scan[6 + k, i]
    return flat


@compiled
def pair(flat, n, part, across):
    """Return pairs of points of the scan and the part: those nearest to each, as flattened.

    ``flat`` are the ``n`` points of the scan (`flat_of`). ``across`` is metres squared that normals
    at right angles add to the square of a distance. The first pairs are those of the points of the
    scan.
    """
    b = part[6:].astype(np.float32)
    m = b.shape[1]
    pairs = np.empty((2, n + m), np.int32)
    best, home = _nearest(flat, b, np.float32(across))
    for i in range(n):  # slices that are assigned to take a second to compile
        pairs[0, i], pairs[1, i] = i, best[i]
    for j in range(m):
        pairs[0, n + j], pairs[1, n + j] = home[j], j
    return pairs


@compiled
def _nearest(a, b, weight):
    """Return the nearest column of b for each of a, and of a for each of b.

    The inner loops compile to vectors, and two columns of b share what is read of a. Squares are
    compared as whole numbers, whose order is that of floats that are not negative.
    """
    n, m = a.shape[1], b.shape[1]
    least, best, home = np.full(n, np.float32(1e9)), np.zeros(n, np.int32), np.empty(m, np.int32)
    squares = np.empty((2, n), np.float32)
    bits = squares.view(np.int32)
    first, second = squares[0], squares[1]
    x, y, z, u, v, w = a[0], a[1], a[2], a[3], a[4], a[5]
    for j in range(0, m, 2):
        k = min(j + 1, m - 1)  # the last of an odd number is looked at twice
        d, e, f, p, q, r = b[0, j], b[1, j], b[2, j], b[3, j], b[4, j], b[5, j]
        d2, e2, f2, p2, q2, r2 = b[0, k], b[1, k], b[2, k], b[3, k], b[4, k], b[5, k]
        number, number2 = np.int32(j), np.int32(k)
        for i in range(n):
            near, at = least[i], best[i]
            square = _square(x[i] - d, y[i] - e, z[i] - f, u[i] * p + v[i] * q + w[i] * r, weight)
            first[i] = square
            nearer = square < near
            near, at = square if nearer else near, number if nearer else at
            square = _square(
                x[i] - d2, y[i] - e2, z[i] - f2, u[i] * p2 + v[i] * q2 + w[i] * r2, weight
            )
            second[i] = square
            nearer = square < near
            least[i], best[i] = square if nearer else near, number2 if nearer else at
        home[j], home[k] = _first_least(bits[0]), _first_least(bits[1])
    return best, home


@compiled
def _square(x, y, z, along, weight):
    none, aslant = np.float32(0), np.float32(1) - along * along
    return x * x + y * y + z * z + weight * (aslant if aslant > none else none)


@compiled
def _first_least(values):
    low, last = values[0], np.int32(len(values))
    for i in range(len(values)):
        low = values[i] if values[i] < low else low
    first = last
    for i in range(len(values)):
        here = np.int32(i) if values[i] == low else last
        first = here if here < first else first
    return first


@compiled
def off_discs(scan, part, pairs, gap, scan_gap):
    """Return how far points of the scan are off discs of the part, in the flattened space.

    Three rows: along the normal, beside the centre, and beyond the radius of the disc, which is the
    spacing of the points among which the nearest was sought.
    """
    out = np.empty((3, pairs.shape[1]))
    for number in range(pairs.shape[1]):
        i, j = pairs[0, number], pairs[1, number]
        along, square = 0.0, 0.0
        for k in range(3):
            along += part[3 + k, j] * (scan[k, i] - part[k, j])
            square += (scan[6 + k, i] - part[6 + k, j]) ** 2
        aside = np.sqrt(max(square - along * along, 0.0))
        out[0, number], out[1, number] = along, aside
        out[2, number] = max(aside - (gap if number < scan.shape[1] else scan_gap), 0.0)
    return out


@compiled
def _gram(rows, weight):
    """Return the weighted sums of the products of seven rows."""
    out = np.zeros((7, 7))
    for number in range(len(weight)):
        if weight[number] == 0:
            continue
        for i in range(7):
            scaled = rows[i, number] * weight[number]
            for j in range(i + 1):
                out[i, j] += scaled * rows[j, number]
    for i in range(7):
        for j in range(i):
            out[j, i] = out[i, j]
    return out


@compiled
def _add_points(matrix, vector, sums, sight, deep):
    """Add distances between points to the normal equations of a turn and a shift.

    ``sums`` are those of `_gram` of point, miss and 1. A turn moves a point x by θ × x, whose
    square counts less along the sight: by M = I − (1 − 1/deep²) s sᵀ.
    """
    less = 1 - 1 / (deep * deep)
    square = np.eye(3)
    for i in range(3):
        for j in range(3):
            square[i, j] -= less * sight[i] * sight[j]
    for i in range(3):  # the axes e, which turn x by e × x
        j, k = (i + 1) % 3, (i + 2) % 3
        for other in range(3):
            moment = sums[j, 6] * square[k, other] - sums[k, 6] * square[j, other]
            matrix[i, 3 + other] += moment
            matrix[3 + other, i] += moment
            matrix[3 + i, 3 + other] += sums[6, 6] * square[i, other]
            vector[3 + i] += square[i, other] * sums[3 + other, 6]
            vector[i] += square[k, other] * sums[j, 3 + other]
            vector[i] -= square[j, other] * sums[k, 3 + other]
        for other in range(3):
            p, q = (other + 1) % 3, (other + 2) % 3
            matrix[i, other] += (
                sums[j, p] * square[k, q] - sums[j, q] * square[k, p]
                - sums[k, p] * square[j, q] + sums[k, q] * square[j, p]
            )  # fmt: skip


@compiled
def align(
    scan: Float32[np.ndarray, "n 3"],
    scan_normals: Float32[np.ndarray, "n 3"],
    points: Float32[np.ndarray, "m 3"],
    normals: Float32[np.ndarray, "m 3"],
    turn: Float[np.ndarray, "3 3"],
    shift: Float[np.ndarray, "3"],
    steps: int,
    wide: float,
    narrow: float,
    gap: float,
    scan_gap: float,
    across: float,
    floor: float,
    held: float,
    down: Float[np.ndarray, "3"],
    sight: Float[np.ndarray, "3"],
    deep: float,
    judged: bool,
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], float]:
    """Return a better rotation and shift, and the mean robust square of the distances.

    Args:
        scan: Points of the scan.
        scan_normals: Their normals of either sign.
        points: Visible points of the part.
        normals: Their normals.
        turn: Rotation from the part to the scan.
        shift: Translation from the part to the scan.
        steps: Number of steps.
        wide: Metres of the robust kernel at the first step.
        narrow: The same at the last step.
        gap: Spacing of the points of the part.
        scan_gap: Spacing of the points of the scan.
        across: See `pair`.
        floor: Height by which the part must rise to stand on the table.
        held: Weight of the table per pair: 0 without a table.
        down: Unit vector of the part that points down.
        sight: Unit vector of the scan that points to the camera.
        deep: How many times less certain depth is than what lies across the line of sight.
        judged: Whether the mean of the last pose is wanted, which costs as much as a step; without,
            it is that of the pose before.
    """
    fixed = placed(columns_of(scan, scan_normals), np.eye(3), np.zeros(3), sight, deep)
    return settle(
        fixed, flat_of(fixed), columns_of(points, normals), turn, shift, steps, wide, narrow, gap,
        scan_gap, across, floor, held, down, sight, deep, judged,
    )  # fmt: skip


@compiled
def weigh(fixed, flat, posed, kernel, gap, scan_gap, across):
    """Return pairs, how far they are off (`off_discs`), two weights of each, and the cost.

    The weights are those of the distance along the normal and of that between the points.
    """
    n, m = fixed.shape[1], posed.shape[1]
    pairs = pair(flat, n, posed, across)
    off = off_discs(fixed, posed, pairs, gap, scan_gap)
    weights, slides, errors = np.empty(n + m), np.empty(n + m), np.empty(n + m)
    first, second = 1 / n, 1 / m
    for number in range(n + m):
        along, aside, excess = off[0, number], off[1, number], off[2, number]
        share = first if number < n else second
        error = along * along + excess * excess
        slide = (excess / max(aside, 1e-12)) ** 2
        ratio = 1 / (1 + error / (kernel * kernel))
        errors[number] = error * ratio * share
        weight = ratio * ratio * share
        weights[number], slides[number] = weight * (1 - slide), weight * slide
    cost = 0.0
    for number in range(n + m):
        cost += errors[number]
    return pairs, off, weights, slides, cost


@compiled
def settle(
    fixed, flat, part, turn, shift, steps, wide, narrow, gap,
    scan_gap, across, floor, held, down, sight, deep, judged,
):  # fmt: skip
    """Return what `align` does, of a scan that is placed (`placed`, `flat_of`) and of columns."""
    turn, shift = turn.copy(), shift.copy()
    n, m = fixed.shape[1], part.shape[1]
    planes, discs = np.empty((7, n + m)), np.empty((7, n + m))
    cost = 0.0
    for step in range(steps + judged):
        kernel = wide * (narrow / wide) ** min(step / max(steps - 1, 1), 1.0)
        posed = placed(part, turn, shift, sight, deep)
        pairs, off, weights, slides, cost = weigh(fixed, flat, posed, kernel, gap, scan_gap, across)
        if step == steps:
            break
        count = 0
        for number in range(n + m):
            i, j = pairs[0, number], pairs[1, number]
            x, y, z = posed[0, j], posed[1, j], posed[2, j]
            u, v, w = posed[3, j], posed[4, j], posed[5, j]
            planes[0, number], planes[1, number] = y * w - z * v, z * u - x * w
            planes[2, number], planes[3, number] = x * v - y * u, u
            planes[4, number], planes[5, number], planes[6, number] = v, w, off[0, number]
            if slides[number] > 0:  # few are
                slides[count] = slides[number]
                discs[0, count], discs[1, count], discs[2, count] = x, y, z
                for k in range(3):
                    discs[3 + k, count] = fixed[k, i] - posed[k, j]
                discs[6, count] = 1
                count += 1
        sums = _gram(planes, weights)
        matrix, vector = sums[:6, :6].copy(), sums[6, :6].copy()
        _add_points(matrix, vector, _gram(discs, slides[:count]), sight, deep)
        turning = (matrix[0, 0] + matrix[1, 1] + matrix[2, 2]) / 3
        if held > 0:
            matrix[5, 5] += held
            vector[5] += held * floor
            # The turn that brings ``down`` to the vertical, −z, is cross(down, −z).
            tilt = _applied(turn, down)
            matrix[0, 0] += held * turning * 25
            matrix[1, 1] += held * turning * 25
            vector[0] -= held * turning * 25 * tilt[1]
            vector[1] += held * turning * 25 * tilt[0]
        for i in range(3):
            matrix[i, i] += 1e-4 * turning + 1e-12
            matrix[3 + i, 3 + i] += 1e-4
        twist = _solved(matrix, vector)
        angle = np.sqrt(twist[0] ** 2 + twist[1] ** 2 + twist[2] ** 2)
        if angle > 0.35:  # a step of more than 20° leaves the range of the linear form
            twist *= 0.35 / angle
        delta = _rotation(twist)
        turn = _product(delta, turn)
        shift = _applied(delta, shift) + twist[3:]
        floor -= twist[5]
    return turn, shift, cost


@compiled
def _applied(matrix, vector):
    out = np.zeros(3)
    for i in range(3):
        for k in range(3):
            out[i] += matrix[i, k] * vector[k]
    return out


@compiled
def _product(first, second):
    out = np.zeros((3, 3))
    for i in range(3):
        for k in range(3):
            for j in range(3):
                out[i, k] += first[i, j] * second[j, k]
    return out


@compiled
def _solved(matrix, vector):
    """Solve a symmetric positive system of six equations by Cholesky's method."""
    lower, out = np.zeros((6, 6)), vector.copy()
    for i in range(6):
        for j in range(i + 1):
            left = matrix[i, j]
            for k in range(j):
                left -= lower[i, k] * lower[j, k]
            lower[i, j] = np.sqrt(max(left, 1e-18)) if i == j else left / lower[j, j]
    for i in range(6):
        for k in range(i):
            out[i] -= lower[i, k] * out[k]
        out[i] /= lower[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            out[i] -= lower[k, i] * out[k]
        out[i] /= lower[i, i]
    return out


@compiled
def _rotation(twist):
    """Return the rotation by a vector of axis times angle (Rodrigues)."""
    angle = np.sqrt(twist[0] ** 2 + twist[1] ** 2 + twist[2] ** 2)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = twist[0] / angle, twist[1] / angle, twist[2] / angle
    s, c = np.sin(angle), np.cos(angle)
    d = 1 - c
    return np.array(
        [
            [c + x * x * d, x * y * d - z * s, x * z * d + y * s],
            [y * x * d + z * s, c + y * y * d, y * z * d - x * s],
            [z * x * d - y * s, z * y * d + x * s, c + z * z * d],
        ]
    )
