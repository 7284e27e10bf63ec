"""The largest piece of a cloud, by a flood."""

import numpy as np

from qs3.points.compiled import compiled


@compiled
def flood(points, order, axis, gap):
    """Return which points of a cloud are in its largest piece.

    ``points`` are in rising order of the coordinate ``axis``, which ends the search for neighbours;
    ``order`` has their places in the cloud.
    """
    n = len(points)
    piece, queue, place = np.full(n, -1), np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        place[order[i]] = i
    square, best, most, number = gap * gap, 0, 0, 0
    for seed in place:
        if piece[seed] >= 0:
            continue
        piece[seed], queue[0] = number, seed
        done, count = 0, 1
        while done < count:
            i = queue[done]
            x = points[i, axis]
            done += 1
            for step in (-1, 1):
                j = i + step
                while 0 <= j < n and abs(points[j, axis] - x) <= gap:
                    if piece[j] < 0:
                        far = 0.0
                        for k in range(points.shape[1]):
                            far += (points[j, k] - points[i, k]) ** 2
                        if far <= square:
                            piece[j], queue[count] = number, j
                            count += 1
                    j += step
        if count > most:
            best, most = number, count
        number += 1
    found = np.empty(n, np.bool_)
    for i in range(n):
        found[order[i]] = piece[i] == best
    return found
