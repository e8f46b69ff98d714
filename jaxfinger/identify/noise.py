"""Noise of each channel, and the filter that whitens it.

At a fit's rate the noise of a channel is modelled as autoregressive: e_t = Σ_k a_k e_{t−k} + σ w_t, with w white. So
the filtered residuals (r_t − Σ_k a_k r_{t−k}) / σ are white with unit variance where r is noise, and least squares of
them is generalised least squares.

The noise is estimated from the best source that the trials offer. From best to worst these are differences between
trials that repeat one motion (pure error, which includes the noise of the inputs), the scatter within holds, and the
residuals of a fit, which may hide part of a gap. `without_recurring_laws` takes from these what recurs with the state.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Array, Float
from scipy.ndimage import uniform_filter1d
from scipy.spatial.distance import cdist

from jaxfinger.data.schema import CHANNELS
from jaxfinger.data.signals.noise import STD_PER_MAD
from jaxfinger.experiments import Batch, Stack

ORDER = 3  # of the autoregression: describes white noise after a low-pass (tests/identify/test_noise.py)
# A column needs more samples than the first for a standard deviation of its own, known to 10 % from 50 (1/√(2 n)), and
# more than the second for coefficients a_k of its own, known to 0.03 from 1000 (1/√n).
MIN_SAMPLES_FOR_STD, MIN_SAMPLES_FOR_COEFFICIENTS = 50, 1000
MIN_SAMPLES_OF_SOURCE = 100  # of repeats or holds, below which residuals are used; 100 give a standard deviation to 7 %
MIN_SAMPLES_OF_REPEAT = 20  # common samples of two trials, or runs, alike; fewer add little to an autocovariance
MIN_SAMPLES_OF_HOLD = 5  # a hold needs more: a straight line takes two of them
MIN_HOLDS = 20  # more are needed to scale the noise of holds, whose standard deviation is then known to 16 %
MAX_LAG = 400  # samples over which the means of holds are correlated: 20 s at the rate of held experiments
MIN_STD = 1e-12  # SI units, of residuals that are all zero, as in noiseless files: it keeps filters finite
SPECTRUM = 4096  # frequencies at which the noise's spectrum is evaluated: more than ten times the largest lag
# Samples of the moving average that counts as signal where no motion is repeated: the shorter where the model may lack
# a law, the longer where it is taken to be right. Of the long-run variance of noise such as VD.3's the shorter removes
# more than half, the longer a third at most (tests/identify/test_noise.py).
SIGNAL_WINDOW, LONG_SIGNAL_WINDOW = 15, 75


@dataclass(frozen=True)
class Noise:
    """Noise of one channel in one experiment, at the rate of the reduced data; one row for each column."""

    std: Float[np.ndarray, " columns"]  # standard deviation of a sample, in the channel's unit
    innovation: Float[np.ndarray, " columns"]  # σ, in the channel's unit
    ar: Float[np.ndarray, "columns order"]  # a_k
    source: str  # `repeats`, `holds`, `repeats and holds`, or `residuals`

    @classmethod
    def white(cls, std: Float[np.ndarray, " columns"], source: str) -> "Noise":
        """White noise of these standard deviations."""
        return cls(std, std, np.zeros((len(std), ORDER)), source)

    @property
    def of_repeats(self) -> bool:
        """Whether trials that repeat a motion tell the noise, alone or together with holds."""
        return "repeats" in self.source

    @property
    def coefficients(self) -> Float[np.ndarray, "columns lags lags"]:
        """Whitening filters [1, −a₁, …] / σ; row j uses j past samples, as at the start of a trial or after a gap.

        Filters of lower order follow from Levinson's recursion, run downwards:
        a_k ← (a_k + a_j a_{j−k})/(1 − a_j²), σ² ← σ²/(1 − a_j²).
        """
        order = self.ar.shape[1]
        out = np.zeros((len(self.std), order + 1, order + 1))
        a, sigma = self.ar, self.innovation
        for j in range(order, -1, -1):
            out[:, j, : j + 1] = np.concatenate([np.ones((len(a), 1)), -a], axis=1) / sigma[:, None]
            if j:
                last = np.clip(a[:, -1:], -0.99, 0.99)  # keeps a nearly unstable filter finite
                a = (a[:, :-1] + last * a[:, -2::-1]) / (1.0 - last**2)
                sigma = sigma / np.sqrt(1.0 - last[:, 0] ** 2)
        return out


def whiten(
    r: Float[Array | np.ndarray, "*more columns B T"],
    mask: Float[Array | np.ndarray, "columns B T"],
    coefficients: Float[Array | np.ndarray, "columns lags lags"],
    demean: bool,
) -> Float[Array | np.ndarray, "*more columns B T"]:
    """Whiten residuals to unit variance, in their array type; zero where `mask` is 0.

    `coefficients`: `Noise.coefficients`. With `demean`, one constant for each trial and column is projected out, since
    the zero of an encoder is arbitrary.
    """
    xp = r.__array_namespace__()
    mask, coefficients = xp.asarray(mask), xp.asarray(coefficients)
    order = coefficients.shape[1] - 1
    column = np.arange(len(mask))[:, None, None]
    filters = coefficients[column, history(mask, order).astype(int)] * mask[..., None]  # (columns, B, T, lags)
    r = r * mask
    white = filters[..., 0] * r
    for k in range(1, order + 1):
        white = white + filters[..., k] * _lag(r, k)
    if demean:
        constant = filters.sum(axis=-1)
        energy = xp.maximum(xp.sum(constant * constant, axis=-1, keepdims=True), 1e-300)
        white = white - constant * xp.sum(constant * white, axis=-1, keepdims=True) / energy
    return white


def history(mask: Float[Array | np.ndarray, "columns B T"], order: int) -> Float[Array | np.ndarray, "columns B T"]:
    """Number of valid samples right before each sample, without a gap, at most `order`."""
    unbroken, total = mask, 0.0 * mask
    for k in range(1, order + 1):
        unbroken = unbroken * _lag(mask, k)
        total = total + unbroken
    return total


def _lag(a: Float[Array | np.ndarray, "*more T"], k: int) -> Float[Array | np.ndarray, "*more T"]:
    """Delay `a` by k samples, with zeros at the start."""
    xp = a.__array_namespace__()
    return xp.concat([xp.zeros_like(a[..., :k]), a[..., :-k]], axis=-1)


def estimate(
    stack: Stack, channel: str, residual: Float[np.ndarray, "columns B T"], window: int = SIGNAL_WINDOW
) -> Noise:
    """Estimate the noise of a channel from the residuals of a model, by the best source that the stack offers.

    `window`: samples of the moving average that counts as signal where no motion is repeated.
    """
    batch: Batch = stack.batch
    mask = np.asarray(batch.mask[channel]) > 0
    demean = CHANNELS[channel].free_zero
    series, source = _repeats(stack, residual, mask, demean), "repeats"
    if stack.experiment.rests:
        holds = _within_holds(stack, residual, mask)
        source = "repeats and holds" if _enough(series) else "holds"
        series = [a + b for a, b in zip(series, holds, strict=True)]
    if not _enough(series):
        series, source = _fast_part(residual, mask, window), "residuals"
    # A column with too few samples takes the standard deviation or the coefficients of all columns together. Their
    # coefficients are alike, since all pass the same averaging and filters.
    own, whole = [_autoregression(c) for c in series], _autoregression([s for column in series for s in column])
    if not own:  # the channel has no column, as excursions of a machine without tendons
        return Noise(np.zeros(0), np.zeros(0), np.zeros((0, *np.shape(whole[2]))), source)
    few = [_count(c) <= MIN_SAMPLES_FOR_STD for c in series]
    sizes = [whole[0] if less else row[0] for less, row in zip(few, own, strict=True)]
    if any(few) and source != "residuals":
        by_fast = _sizes_by_fast_parts(series, _fast_part(residual, mask, window))
        sizes = [by_fast.get(c, size) if few[c] else size for c, size in enumerate(sizes)]
    scaled = [(e / size, m, lost) for c, size in zip(series, sizes, strict=True) for e, m, lost in c]
    unit, spread, colour = _autoregression(scaled)
    rows = [
        row if _count(c) > MIN_SAMPLES_FOR_COEFFICIENTS else (size, size * spread / unit, colour)
        for c, row, size in zip(series, own, sizes, strict=True)
    ]
    std, innovation, ar = (np.array(x) for x in zip(*rows, strict=True))
    if stack.experiment.held:
        scale = _between_holds(_repeats(stack, residual, mask & (stack.holds >= 0), demean), ar, innovation)
        std, innovation = std * scale, innovation * scale
    return _at_least(Noise(std, innovation, ar, source), stack, channel)


def without_recurring_laws(
    noise: Noise, stack: Stack, channel: str, residual: Float[np.ndarray, "columns B T"]
) -> Noise:
    """Noise from residuals of a model, or in columns where these are less, differences where the same state recurs.

    A law that the model lacks counts as noise in the first, the more so the quicker it is. In the second a law of the
    state cancels.
    """
    if noise.source != "residuals":
        return noise
    mask, demean = np.asarray(stack.batch.mask[channel]) > 0, CHANNELS[channel].free_zero
    std, innovation, ar = (np.array(x) for x in (noise.std, noise.innovation, noise.ar))
    for directed in (0.0, 1.0):
        for c, column in enumerate(_recurring(stack, residual, mask, demean, directed)):
            size, sigma, a = _autoregression(column)
            if _count(column) > MIN_SAMPLES_FOR_STD and size < std[c]:
                std[c], innovation[c], ar[c] = size, sigma, a
    return _at_least(Noise(std, innovation, ar, noise.source), stack, channel)


def _at_least(noise: Noise, stack: Stack, channel: str) -> Noise:
    """Noise, or the error of a coarse converter where that is larger.

    Neither holds nor repeats show that error: it is the same at every sample of a hold and in every repeat. Of an error
    that lasts for L samples, a mean over many has L times the variance that it has where L is 1, as has that of an
    autoregression of order one with the coefficient (L − 1)/(L + 1).
    """
    if channel not in stack.coarseness:
        return noise
    error, lasts = stack.coarseness[channel]
    L = lasts / stack.dt
    error, a = error * np.sqrt(np.minimum(L, 1.0)), np.maximum(L - 1.0, 0.0) / (L + 1.0)
    coarse = error > noise.std
    ar = np.zeros_like(noise.ar)
    ar[:, 0] = a
    return Noise(
        np.where(coarse, error, noise.std),
        np.where(coarse, error * np.sqrt(1.0 - a**2), noise.innovation),
        np.where(coarse[:, None], ar, noise.ar),
        noise.source,
    )


# Values, which of them are valid, and the share of their covariance that removing a mean or a line takes from each lag.
Series = list[tuple[np.ndarray, np.ndarray, float]]


def _sizes_by_fast_parts(series: list[Series], fast: list[Series]) -> dict[int, float]:
    """Standard deviations of the columns whose fast parts have samples enough, in their own units.

    A fast part is not all of the noise. The ratio of the two is taken to be one for all columns.
    """
    sizes = {c: _autoregression(part)[0] for c, part in enumerate(fast) if _count(part) > MIN_SAMPLES_FOR_STD}
    share, _, _ = _autoregression([(e / size, m, lost) for c, size in sizes.items() for e, m, lost in series[c]])
    return {c: share * size for c, size in sizes.items()}


def _count(column: Series) -> int:
    return sum(int(m.sum()) for _, m, _ in column)


def _enough(series: list[Series]) -> bool:
    return sum(map(_count, series)) > MIN_SAMPLES_OF_SOURCE


def _centred(e: np.ndarray, mask: np.ndarray, demean: bool) -> np.ndarray:
    return np.where(mask, e - (e[mask].mean() if demean and mask.any() else 0.0), 0.0)


def repeated_motions(stack: Stack) -> list[list[int]]:
    """Trials of each motion that is repeated, by their numbers in the stack."""
    motions = [m for m in dict.fromkeys(stack.motions) if m is not None and stack.motions.count(m) > 1]
    return [[b for b, name in enumerate(stack.motions) if name == motion] for motion in motions]


def _repeats(stack: Stack, residual, mask, demean) -> list[Series]:
    """Deviations of trials that repeat one motion from their mean, scaled to the noise of a single trial."""
    series: list[Series] = [[] for _ in range(len(residual))]
    for members in repeated_motions(stack):
        for c, column in enumerate(series):
            both = mask[c, members].all(axis=0)
            if both.sum() < MIN_SAMPLES_OF_REPEAT:
                continue
            mean = residual[c, members].mean(axis=0)
            scale = np.sqrt(len(members) / (len(members) - 1))
            column += [(_centred(scale * (residual[c, b] - mean), both, demean), both, 0.0) for b in members]
    return series


def _within_holds(stack: Stack, residual, mask) -> list[Series]:
    """Deviations from a straight line through each hold, which removes creep and relaxation."""
    series: list[Series] = [[] for _ in range(len(residual))]
    for c, b in np.ndindex(residual.shape[:2]):
        e, counts, lost = np.zeros(residual.shape[2]), np.zeros(residual.shape[2], bool), []
        for hold in stack.samples_of_holds(b, mask[c, b]):
            n = len(hold)
            if n > MIN_SAMPLES_OF_HOLD:
                line = np.polyval(np.polyfit(hold, residual[c, b, hold], 1), hold)
                e[hold], counts[hold] = residual[c, b, hold] - line, True
                lost.append(2 / n)
        if counts.any():
            series[c].append((e, counts, float(np.mean(lost))))
    return series


def _between_holds(series: list[Series], ar: np.ndarray, innovation: np.ndarray) -> float:
    """Scatter of the means of holds between repeats over that which the samples' noise explains; at least 1.

    The tension of a hold has an error that all samples of the hold share, and that no scatter within holds shows. The
    torque of a held joint depends on it.
    """
    ratios = []
    for column, a, sigma in zip(series, ar, innovation, strict=True):
        spectrum = np.abs(sigma / np.fft.rfft(np.r_[1.0, -a], SPECTRUM)) ** 2
        covariance = np.fft.irfft(spectrum)[:MAX_LAG]  # Wiener–Khinchin
        for e, counts, _ in column:
            for hold in np.ma.clump_unmasked(np.ma.masked_array(e, ~counts)):
                n = min(hold.stop - hold.start, MAX_LAG)
                expected = (covariance[0] + 2 * ((1 - np.arange(1, n) / n) @ covariance[1:n])) / n
                ratios.append(e[hold].mean() ** 2 / expected)
    return max(1.0, float(np.sqrt(np.mean(ratios)))) if len(ratios) > MIN_HOLDS else 1.0


def _fast_part(residual, mask, window: int) -> list[Series]:
    """Residuals less their moving average over `window` samples, which may be signal."""
    series: list[Series] = [[] for _ in range(len(residual))]
    for c, b in np.ndindex(residual.shape[:2]):
        e, counts = np.where(mask[c, b], residual[c, b], 0.0), mask[c, b]
        if counts.any():
            near, share = (uniform_filter1d(x, window, mode="constant") for x in (e, counts.astype(float)))
            share = np.maximum(share, 1 / window)
            lost = float(np.mean(1 / (window * share[counts])))  # of the valid samples in a window
            series[c].append((np.where(counts, e - near / share, 0.0), counts, lost))
    return series


def _recurring(stack: Stack, residual, mask, demean: bool, directed: float) -> list[Series]:
    """Differences between samples of two runs through the same states, scaled to the noise of a single sample.

    Each run is compared with the one whose states are nearest to a few of its own. Samples count whose states are each
    other's nearest, and which are too far apart in time for the moving average to read both. What depends on the state
    alone cancels. `directed`: weight of the joints' directions in a state; at 1 they differ more than all else can.
    """
    x, series = stack.batch.x, [[] for _ in range(len(residual))]
    sizes = [np.asarray(a) for a in (x.q, np.abs(x.qd), x.tension)]
    scaled = [a / max(np.ptp(a, axis=(1, 2)).max(initial=0.0), 1e-300) for a in sizes]
    states = np.concatenate([*scaled, directed * x.joint_direction])
    for c, column in enumerate(series):
        e = np.array([_centred(r, m, demean) for r, m in zip(residual[c], mask[c], strict=True)])
        b, t, runs = _runs(mask[c], np.asarray(x.joint_direction))
        here = states[:, b, t].T
        for n, run in enumerate(runs):
            if run.stop - run.start < MIN_SAMPLES_OF_REPEAT or len(runs) < 2:
                continue
            probes = here[np.linspace(run.start, run.stop - 1, MIN_SAMPLES_OF_REPEAT).astype(int)]
            nearest_in_runs = np.minimum.reduceat(cdist(probes, here), [r.start for r in runs], axis=1)
            unlike = np.mean(nearest_in_runs**2, axis=0)
            unlike[n] = np.inf
            other = runs[int(np.argmin(unlike))]
            distance = cdist(here[run], here[other])
            nearest, back = (np.argmin(distance, axis=axis) for axis in (1, 0))
            at = other.start + nearest
            counts = (b[at] != b[run]) | (np.abs(t[at] - t[run]) > SIGNAL_WINDOW)
            counts &= back[nearest] == np.arange(len(nearest))
            if counts.sum() < MIN_SAMPLES_OF_REPEAT:
                continue
            difference = (e[b[run], t[run]] - e[b[at], t[at]]) / np.sqrt(2.0)
            column.append((np.where(counts, difference, 0.0), counts, 0.0))
    return series


def _runs(mask: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[slice]]:
    """Trial and time of the samples that count, and the runs among them: without a gap, and without a joint's turn."""
    b, t = np.nonzero(mask)
    turns = np.any(np.diff(np.sign(direction[:, b, t])) != 0.0, axis=0)
    first = np.flatnonzero((np.diff(b) != 0) | (np.diff(t) != 1) | turns) + 1
    return b, t, [slice(i, j) for i, j in itertools.pairwise((0, *first.tolist(), len(b)))]


def _autoregression(series: Series) -> tuple[float, float, np.ndarray]:
    """Standard deviation, innovation σ and coefficients a_k by Yule–Walker, from values clipped at four robust std."""
    if not series or not any(m.any() for _, m, _ in series):
        return 1.0, 1.0, np.zeros(ORDER)
    values = np.concatenate([e[m] for e, m, _ in series])
    # One normal value of 16 000 lies beyond four standard deviations; outliers do, and would dominate the squares.
    limit = 4.0 * STD_PER_MAD * np.median(np.abs(values)) + 1e-300
    clipped = [(np.clip(e, -limit, limit), m, lost) for e, m, lost in series]
    covariance = np.array([_lagged(clipped, k) for k in range(ORDER + 1)])
    if covariance[0] <= 0:
        return MIN_STD, MIN_STD, np.zeros(ORDER)
    covariance[0] *= 1.0 + 1e-6  # keeps the Toeplitz system regular
    ar = scipy.linalg.solve_toeplitz(covariance[:-1], covariance[1:])
    innovation = covariance[0] - ar @ covariance[1:]
    if not 0 < innovation <= covariance[0] * 1.001:
        return float(np.sqrt(covariance[0])), float(np.sqrt(covariance[0])), np.zeros(ORDER)
    return float(np.sqrt(covariance[0])), float(np.sqrt(innovation)), ar


def _lagged(series: Series, k: int) -> float:
    """Autocovariance at lag k, corrected for the removal of d fitted terms from n samples.

    For white samples that removal takes the share d/n of the variance from every lag.
    """
    total = count = removed = 0.0
    for e, m, lost in series:
        both = m[k:] & m[: m.size - k]
        n = int(both.sum())
        total, count = total + float(np.sum(e[k:][both] * e[: e.size - k][both])), count + n
        removed += n * lost * float(np.mean(e[m] ** 2)) / max(1e-9, 1 - lost) if n else 0.0
    return (total + removed) / count if count else 0.0
