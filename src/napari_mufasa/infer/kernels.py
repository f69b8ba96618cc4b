"""The likelihood of many traces under one hidden chain.

Import this module only where traces are fitted: it needs numba.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

compiled: Any = njit(cache=True, nogil=True)
OUTLIER = -50.0  # log of the least density of a count, over that of its best explanation: one freak decides nothing
FREAK = np.exp(OUTLIER)


@compiled
def log_likelihoods(traces, levels, offset, dark_variance, extra_variance, within, widths, between, start):  # type: ignore[no-untyped-def]
    """(molecule,) log likelihood by the forward recursion.

    traces : (molecule, frame); levels : (molecule,) mean of a frame that is bright throughout, above `offset`
    dark_variance, extra_variance : of a frame dark_variance + share · extra_variance (molecule,)
    within : (share, from, to) chance that a frame begins in one state, ends in another and is bright for a share of 0,
        1/n, … 1 of it; widths : (share,) variance of the shares that each stands for
    between : (from, to) from a frame's end to the next one's start; start : (state,)
    """
    n_molecules, n_frames = traces.shape
    n_shares, n_states = within.shape[0], within.shape[1]
    found = np.empty(n_molecules)
    mean, precision, constant = np.empty(n_shares), np.empty(n_shares), np.empty(n_shares)
    exponent, after = np.empty(n_shares), np.empty(n_states)
    for m in range(n_molecules):
        at = start.copy()
        total = 0.0
        for h in range(n_shares):
            share = h / (n_shares - 1)
            variance = dark_variance + share * extra_variance[m] + levels[m] ** 2 * widths[h]
            mean[h], precision[h], constant[h] = offset + share * levels[m], 0.5 / variance, 0.5 * np.log(variance)
        for f in range(n_frames):
            best = -np.inf
            for h in range(n_shares):
                off = traces[m, f] - mean[h]
                exponent[h] = -off * off * precision[h] - constant[h]
                best = max(best, exponent[h])
            after[:] = 0.0
            for h in range(n_shares):
                less = exponent[h] - best
                density = np.exp(less) if less > OUTLIER else FREAK
                for i in range(n_states):
                    weight = density * at[i]
                    for j in range(n_states):
                        after[j] += weight * within[h, i, j]
            size = after.sum()
            total += np.log(size) + best
            for j in range(n_states):
                at[j] = 0.0
                for i in range(n_states):
                    at[j] += after[i] / size * between[i, j]
        found[m] = total
    return found
