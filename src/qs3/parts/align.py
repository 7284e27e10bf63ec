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


@compiled
def pair(scan, scan_normals, points, normals, turn, shift, across, sight, deep):
    """Return the nearest visible point of each point of the scan, and back.

    ``across`` is metres squared that normals at right angles add to the square of a distance.
    """
    n, m = len(scan), len(points)
    moved, part = np.empty((6, n), np.float32), np.empty((6, m), np.float32)
    for i in range(n):
        x, y, z = scan[i, 0] - shift[0], scan[i, 1] - shift[1], scan[i, 2] - shift[2]
        u, v, w = scan_normals[i, 0], scan_normals[i, 1], scan_normals[i, 2]
        for k in range(3):
            moved[k, i] = turn[0, k] * x + turn[1, k] * y + turn[2, k] * z
            moved[3 + k, i] = turn[0, k] * u + turn[1, k] * v + turn[2, k] * w
    for j in range(m):
        for k in range(3):
            part[k, j], part[3 + k, j] = points[j, k], normals[j, k]
    if deep != 1:
        ahead = np.zeros(3)
        for k in range(3):
            for other in range(3):
                ahead[k] += turn[other, k] * sight[other]
        _flatten(moved, ahead, deep)
        _flatten(part, ahead, deep)
    weight = np.float32(across)
    return _nearest(moved, part, weight), _nearest(part, moved, weight)


@compiled
def _flatten(columns, ahead, deep):
    """Flatten points along a direction, and turn their normals by as much."""
    for i in range(columns.shape[1]):
        far, facing, length = 0.0, 0.0, 0.0
        for k in range(3):
            far += columns[k, i] * ahead[k]
            facing += columns[3 + k, i] * ahead[k]
        for k in range(3):
            columns[k, i] += (1 / deep - 1) * far * ahead[k]
            columns[3 + k, i] += (deep - 1) * facing * ahead[k]
            length += columns[3 + k, i] ** 2
        for k in range(3):
            columns[3 + k, i] /= np.sqrt(length)


@compiled
def _nearest(a, b, weight):
    """Return the nearest column of b for each of a; the inner loop compiles to vectors."""
    n, m = a.shape[1], b.shape[1]
    least, best = np.full(n, np.float32(1e9)), np.zeros(n, np.int32)
    x, y, z, u, v, w = a[0], a[1], a[2], a[3], a[4], a[5]
    one = np.float32(1)
    for j in range(m):
        d, e, f, p, q, r = b[0, j], b[1, j], b[2, j], b[3, j], b[4, j], b[5, j]
        number = np.int32(j)
        for i in range(n):
            g, h, k = x[i] - d, y[i] - e, z[i] - f
            along = u[i] * p + v[i] * q + w[i] * r
            square = g * g + h * h + k * k + weight * (one - along * along)
            nearer = square < least[i]
            least[i] = square if nearer else least[i]
            best[i] = number if nearer else best[i]
    return best


@compiled
def off_disc(scan, points, normals, i, j, turn, shift, allowed, sight, deep, x, normal, miss):
    """Return how far a point of the scan is off a disc of the part, in the flattened space.

    Four numbers: along the normal; beside the centre; beyond the disc's radius ``allowed``; and by
    how many times flattening shortens a distance along the normal. Fills ``x``, ``normal`` and
    ``miss``: centre and normal of the disc in the scan's axes, and the way from it to the point.
    """
    along, facing, far, square = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        x[k], normal[k] = shift[k], 0.0
        for other in range(3):
            x[k] += turn[k, other] * points[j, other]
            normal[k] += turn[k, other] * normals[j, other]
        miss[k] = scan[i, k] - x[k]
        along += normal[k] * miss[k]
        facing += normal[k] * sight[k]
        far += miss[k] * sight[k]
        square += miss[k] * miss[k]
    stretch = np.sqrt(1 + (deep * deep - 1) * facing * facing)
    along /= stretch
    square -= (1 - 1 / (deep * deep)) * far * far
    aside = np.sqrt(max(square - along * along, 0.0))
    return along, aside, max(aside - allowed, 0.0), stretch


@compiled
def _add_plane(matrix, vector, row, x, normal, miss, weight):
    """Add a distance along a normal to the normal equations of a turn and a shift."""
    row[0] = x[1] * normal[2] - x[2] * normal[1]
    row[1] = x[2] * normal[0] - x[0] * normal[2]
    row[2] = x[0] * normal[1] - x[1] * normal[0]
    row[3], row[4], row[5] = normal[0], normal[1], normal[2]
    along = normal[0] * miss[0] + normal[1] * miss[1] + normal[2] * miss[2]
    for i in range(6):
        vector[i] += weight * along * row[i]
        for j in range(i + 1):
            matrix[i, j] += weight * row[i] * row[j]


@compiled
def _add_point(matrix, vector, x, miss, weight):
    """Add a distance between two points."""
    square = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
    for i in range(3):
        for j in range(i + 1):
            matrix[i, j] -= weight * x[i] * x[j]
        matrix[i, i] += weight * square
        matrix[3 + i, 3 + i] += weight
        vector[3 + i] += weight * miss[i]
    matrix[3, 1] += weight * x[2]
    matrix[3, 2] -= weight * x[1]
    matrix[4, 0] -= weight * x[2]
    matrix[4, 2] += weight * x[0]
    matrix[5, 0] += weight * x[1]
    matrix[5, 1] -= weight * x[0]
    vector[0] += weight * (x[1] * miss[2] - x[2] * miss[1])
    vector[1] += weight * (x[2] * miss[0] - x[0] * miss[2])
    vector[2] += weight * (x[0] * miss[1] - x[1] * miss[0])


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
    """
    turn, shift = turn.copy(), shift.copy()
    n, m = len(scan), len(points)
    cost = 0.0
    x, miss, normal, row = np.empty(3), np.empty(3), np.empty(3), np.empty(6)
    for step in range(steps + 1):
        share = step / max(steps - 1, 1)
        kernel = wide * (narrow / wide) ** min(share, 1.0)
        near, back = pair(scan, scan_normals, points, normals, turn, shift, across, sight, deep)
        matrix, vector = np.zeros((6, 6)), np.zeros(6)
        out, home = 0.0, 0.0
        for number in range(n + m):
            if number < n:
                i, j, allowed = number, near[number], gap
            else:
                i, j, allowed = back[number - n], number - n, scan_gap
            along, aside, excess, stretch = off_disc(
                scan, points, normals, i, j, turn, shift, allowed, sight, deep, x, normal, miss
            )
            error = along * along + excess * excess
            slide = (excess / max(aside, 1e-12)) ** 2
            ratio = 1 / (1 + error / (kernel * kernel))
            if number < n:
                out += error * ratio
            else:
                home += error * ratio
            weight = ratio * ratio * (1 / n if number < n else 1 / m)
            plane = weight * (1 - slide) / (stretch * stretch)
            _add_plane(matrix, vector, row, x, normal, miss, plane)
            if slide > 0:
                _add_point(matrix, vector, x, miss, weight * slide)
                less = weight * slide * (1 - 1 / (deep * deep))
                _add_plane(matrix, vector, row, x, sight, miss, -less)
        cost = out / n + home / m
        if step == steps:
            break
        for i in range(6):
            for j in range(i):
                matrix[j, i] = matrix[i, j]
        size = (matrix[0, 0] + matrix[1, 1] + matrix[2, 2]) / 3
        if held > 0:
            matrix[5, 5] += held
            vector[5] += held * floor
            # The turn that brings ``down`` to the vertical, −z, is cross(down, −z).
            tilt = _applied(turn, down)
            matrix[0, 0] += held * size * 25
            matrix[1, 1] += held * size * 25
            vector[0] -= held * size * 25 * tilt[1]
            vector[1] += held * size * 25 * tilt[0]
        for i in range(3):
            matrix[i, i] += 1e-4 * size + 1e-12
            matrix[3 + i, 3 + i] += 1e-4
        twist = _solved(matrix, vector)
        angle = np.sqrt(twist[0] ** 2 + twist[1] ** 2 + twist[2] ** 2)
        if angle > 0.35:  # a step of more than 20° leaves the range of the linear form
            twist *= 0.35 / angle
        delta = _rotation(twist)
        for k in range(3):
            turn[:, k] = _applied(delta, turn[:, k])
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
