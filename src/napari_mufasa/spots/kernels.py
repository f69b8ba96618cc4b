"""The loops over pixels that finding and following spots takes.

Import this module only where spots are looked for: it needs numba. Functions of a module are compiled once for a
machine (see `camera.kernels`).
"""

from __future__ import annotations

import numpy as np

from napari_mufasa.compiled import inlined, vectorised
from napari_mufasa.spots.times import MIDDLE

TERMS = 7  # of the Taylor series of a spot, and a constant


@vectorised
def block_means(stack, edges):  # type: ignore[no-untyped-def]
    """(block, y, x) float32 means of the frames edges[b] … edges[b + 1] − 1 of a stack (frame, y, x)."""
    _, height, width = stack.shape
    n_blocks = edges.size - 1
    result = np.zeros((n_blocks, height, width), np.float32)
    for b in range(n_blocks):
        share = np.float32(1.0 / max(edges[b + 1] - edges[b], 1))
        for t in range(edges[b], edges[b + 1]):
            for y in range(height):
                for x in range(width):
                    result[b, y, x] += np.float32(stack[t, y, x])
        for y in range(height):
            for x in range(width):
                result[b, y, x] *= share
    return result


@inlined
def blurred(values, weights, step, out):  # type: ignore[no-untyped-def]
    """Symmetric blur of a row of numbers by half of its weights (centre first), `step` numbers from one to the next.

    The ends within (weights.size − 1) · step are left as they are.
    """
    margin = (weights.size - 1) * step
    n = values.size - 2 * margin
    inner, target = values[margin : margin + n], out[margin : margin + n]
    for i in range(n):
        target[i] = weights[0] * inner[i]
    # Plain indices from 0, so that these loops become vector instructions; two weights at a time halve the stores.
    for k in range(1, weights.size - 1, 2):
        before, after = values[margin - k * step :], values[margin + k * step :]
        earlier, later = values[margin - (k + 1) * step :], values[margin + (k + 1) * step :]
        one, two = weights[k], weights[k + 1]
        for i in range(n):
            target[i] += one * (before[i] + after[i]) + two * (earlier[i] + later[i])
    if weights.size % 2 == 0:
        before, after = values[:], values[2 * margin :]
        one = weights[weights.size - 1]
        for i in range(n):
            target[i] += one * (before[i] + after[i])


@vectorised
def spot_filter(images, narrow, wide, rows, columns):  # type: ignore[no-untyped-def]
    """Narrow minus wide blur of images (image, y, x) float32, each by halves of symmetric weights (centre first).

    rows, columns : the pixel that stands at each place of the field and of a margin of wide.size − 1 around it
    """
    n, height, width = images.shape
    margin = wide.size - 1
    result = np.empty(images.shape, np.float32)
    shape = (rows.size, columns.size)
    field, across = np.empty(shape, np.float32), np.zeros(shape, np.float32)
    near, far = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for i in range(n):
        for y in range(rows.size):
            line, place = images[i, rows[y]], field[y]
            place[margin : margin + width] = line
            for x in range(margin):
                place[x] = line[columns[x]]
                place[margin + width + x] = line[columns[margin + width + x]]
        blurred(field.ravel(), narrow, 1, across.ravel())
        blurred(across.ravel(), narrow, columns.size, near.ravel())
        blurred(field.ravel(), wide, 1, across.ravel())
        blurred(across.ravel(), wide, columns.size, far.ravel())
        for y in range(height):
            for x in range(width):
                result[i, y, x] = near[margin + y, margin + x] - far[margin + y, margin + x]
    return result


@vectorised
def take_in(filtered, known, total, steps, shortest, middle):  # type: ignore[no-untyped-def]
    """Take filtered images (image, y, x) into their sum, their squared steps, and the largest value of one and of the
    mean of `MIDDLE` in a row; the first `known` of them were taken in before."""
    n, height, width = filtered.shape
    share = np.float32(1.0 / MIDDLE)
    for i in range(known, n):
        for y in range(height):
            now, before = filtered[i, y], filtered[i - 1, y]
            for x in range(width):
                total[y, x] += now[x]
                shortest[y, x] = max(shortest[y, x], now[x])
            if i > 0:
                for x in range(width):
                    step = now[x] - before[x]
                    steps[y, x] += step * step
            if i + 1 >= MIDDLE:
                a, b, c = filtered[i - 4, y], filtered[i - 3, y], filtered[i - 2, y]
                for x in range(width):
                    middle[y, x] = max(middle[y, x], (a[x] + b[x] + c[x] + before[x] + now[x]) * share)


@vectorised
def moved_back(images, shifts):  # type: ignore[no-untyped-def]
    """Images (image, y, x) float32 with shifts (image, 2) undone, interpolated; the edge goes on outside the field."""
    n, height, width = images.shape
    result = np.empty(images.shape, np.float32)
    for i in range(n):
        whole_y, whole_x = np.floor(shifts[i, 0]), np.floor(shifts[i, 1])
        fy, fx = np.float32(shifts[i, 0] - whole_y), np.float32(shifts[i, 1] - whole_x)
        one = np.float32(1.0)
        for y in range(height):
            y0 = min(max(y + int(whole_y), 0), height - 1)
            y1 = min(max(y + int(whole_y) + 1, 0), height - 1)
            for x in range(width):
                x0 = min(max(x + int(whole_x), 0), width - 1)
                x1 = min(max(x + int(whole_x) + 1, 0), width - 1)
                upper = (one - fx) * images[i, y0, x0] + fx * images[i, y0, x1]
                lower = (one - fx) * images[i, y1, x0] + fx * images[i, y1, x1]
                result[i, y, x] = (one - fy) * upper + fy * lower
    return result


@vectorised
def fit_weights(centre, size, sigma):  # type: ignore[no-untyped-def]
    """Weights (molecule, block, 6, y, x) that give a spot's light, its shift (y, x) and its change of σ²/2 (yy, xx) and
    shear (yx), for spots at `centre` (molecule, block, 2) in windows of `size` pixels a side.

    Rows of the pseudo-inverse of the terms of the Taylor series of a Gaussian spot: G, −∂G, ½∂²G …, plus a constant.
    The derivatives beyond the shift are orthogonalised after the first four, so that light and shift keep their small
    variance. A term is a product of one along y and one along x, so sums of products of two are, too.
    """
    n_molecules, n_blocks, _ = centre.shape
    result = np.empty((n_molecules, n_blocks, 6, size, size))
    along, gram, inverse = np.ones((2, TERMS, size)), np.empty((TERMS, TERMS)), np.empty((TERMS, TERMS))
    for m in range(n_molecules):
        for b in range(n_blocks):
            for axis in range(2):
                for i in range(size):
                    d = i - centre[m, b, axis]
                    g = np.exp(-d * d / (2.0 * sigma**2)) / (np.sqrt(2.0 * np.pi) * sigma)
                    slope, bend = g * d / sigma**2, 0.5 * g * (d * d - sigma**2) / sigma**4
                    along[axis, 0, i], along[axis, 1 + axis, i], along[axis, 2 - axis, i] = g, slope, g
                    along[axis, 4 + axis, i], along[axis, 5 - axis, i], along[axis, 6, i] = bend, g, slope
            for k in range(TERMS):
                for j in range(TERMS):
                    gram[k, j] = (along[0, k] * along[0, j]).sum() * (along[1, k] * along[1, j]).sum()
            for first, last, n in ((0, 3, 4), (4, 7, TERMS)):
                invert(gram, n, inverse)
                for k in range(first, last):
                    window = result[m, b, k if k < 3 else k - 1]
                    window[:] = 0.0
                    for j in range(n):
                        for y in range(size):
                            share = inverse[k, j] * along[0, j, y]
                            for x in range(size):
                                window[y, x] += share * along[1, j, x]
    return result


@inlined
def invert(matrix, n, inverse):  # type: ignore[no-untyped-def]
    """The inverse of the first n rows and columns of a symmetric positive matrix (Gauss and Jordan, in place)."""
    inverse[:n, :n] = matrix[:n, :n]
    for p in range(n):
        pivot = 1.0 / inverse[p, p]
        inverse[p, p] = 1.0
        for j in range(n):
            inverse[p, j] *= pivot
        for i in range(n):
            if i != p:
                factor, inverse[i, p] = inverse[i, p], 0.0
                for j in range(n):
                    inverse[i, j] -= factor * inverse[p, j]


@vectorised
def amplitudes(movie, baseline, corner, weights, block_of):  # type: ignore[no-untyped-def]
    """Weighted sums (molecule, frame, term) of the counts in each spot's window."""
    n_molecules, n_blocks, n_terms, size, _ = weights.shape
    n_frames = movie.shape[0]
    rows = weights.reshape(n_molecules, n_blocks, n_terms, size * size)
    result = np.zeros((n_molecules, n_frames, n_terms))
    values = np.empty(size * size)
    for m in range(n_molecules):
        for t in range(n_frames):
            b = block_of[t]
            y0, x0 = corner[m, b, 0], corner[m, b, 1]
            for i in range(size):
                line, place = movie[t, y0 + i, x0 : x0 + size], values[i * size : (i + 1) * size]
                for j in range(size):
                    place[j] = line[j] - baseline
            for k in range(n_terms):
                weight, total = rows[m, b, k], 0.0
                for p in range(size * size):
                    total += weight[p] * values[p]
                result[m, t, k] = total
    return result


@vectorised
def walks(t, path, shares):  # type: ignore[no-untyped-def]
    """(share, 5) of places (sighting, 2) at times t as a random walk with steady drift, seen with errors, for shares of
    the walk in q + s = 1 (see `diffusion.motion_of`): twice the part of −ln likelihood that no scale changes, the sum
    of squares that is divided by the scale, drift along y and x, and the information on it.

    The recursion of Kalman from the first sighting on; the drift is fitted beside it (restricted likelihood).
    """
    result = np.empty((shares.size, 5))
    for k in range(shares.size):
        q = shares[k] * 4.0 / 3.0
        s = 1.0 - q
        variance, logs, information = s, 0.0, 0.0
        time, y, x = t[0], path[0, 0], path[0, 1]
        yy, xx, ty, tx = 0.0, 0.0, 0.0, 0.0
        for i in range(1, t.size):
            variance += q * (t[i] - t[i - 1])
            total = max(variance + s, 1e-12)
            gain = variance / total
            dt, dy, dx = t[i] - time, path[i, 0] - y, path[i, 1] - x
            logs += np.log(total)
            information += dt * dt / total
            ty += dt * dy / total
            tx += dt * dx / total
            yy += dy * dy / total
            xx += dx * dx / total
            time += gain * dt
            y += gain * dy
            x += gain * dx
            variance *= s / total
        result[k, 0] = 2.0 * (logs + np.log(information))
        result[k, 1] = yy + xx - (ty * ty + tx * tx) / information
        result[k, 2] = ty / information
        result[k, 3] = tx / information
        result[k, 4] = information
    return result


@vectorised
def ring_planes(frame, positions, centre, lit, inner, outer, enough, tells, doubt):  # type: ignore[no-untyped-def]
    """(3, candidate) mean, and slopes along y and x, of the pixels of a frame (y, x) between two distances of each
    position (candidate, 2) that are not `lit` (y, x); of all of them where fewer than `enough` are left, of the square
    around where there are none. `tells` pixels and more of the first tell slopes, fewer none; `doubt` : see `aperture`
    """
    height, width = frame.shape
    n = positions.shape[0]
    result = np.zeros((3, n))
    for i in range(n):
        for attempt in range(3):
            least, dark = (enough, True) if attempt == 0 else (1, False)
            low, high = (inner, 1.0 * outer) if attempt < 2 else (0.0, 2.0 * outer)
            count, v, y1, x1, yy, yx, xx, vy, vx = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for y in range(max(centre[i, 0] - outer, 0), min(centre[i, 0] + outer + 1, height)):
                dy = y - positions[i, 0]
                for x in range(max(centre[i, 1] - outer, 0), min(centre[i, 1] + outer + 1, width)):
                    dx = x - positions[i, 1]
                    if low * low <= dy * dy + dx * dx <= high * high and not (dark and lit[y, x]):
                        value = np.float64(frame[y, x])
                        count += 1
                        v += value
                        y1 += dy
                        x1 += dx
                        yy += dy * dy
                        yx += dy * dx
                        xx += dx * dx
                        vy += value * dy
                        vx += value * dx
            if count >= least:
                v, y1, x1 = v / count, y1 / count, x1 / count
                result[0, i] = v
                if dark and count >= tells:
                    yy, xx, yx = yy - count * y1 * y1 + doubt, xx - count * x1 * x1 + doubt, yx - count * y1 * x1
                    vy, vx = vy - count * v * y1, vx - count * v * x1
                    result[1, i] = (xx * vy - yx * vx) / (yy * xx - yx * yx)
                    result[2, i] = (yy * vx - yx * vy) / (yy * xx - yx * yx)
                break
    return result
