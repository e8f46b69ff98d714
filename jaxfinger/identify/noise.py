"""Noise of each channel, and the filter that makes it white.

At a fit's rate the noise of a channel is autoregressive: e_t = Σ_k a_k e_{t−k} + σ w_t, w white. Then
r_t − Σ_k a_k r_{t−k}, divided by σ, is white when r is, which is generalised least squares with a short filter.
Its source, best first: differences between trials that repeat one motion (pure error, the motion's and the inputs'
noise included), scatter within holds, the residuals themselves (which hide part of a gap, and are named so).
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Array, Float
from scipy.ndimage import uniform_filter1d

from jaxfinger.data.schema import CHANNELS
from jaxfinger.experiments import Batch, Stack

ORDER = 3  # of the autoregression
FEW, MANY = 50, 1000  # samples by which a column tells its size, and its colour
# Samples of the moving average that is taken for signal where nothing is repeated: where a law may be missing, and
# where the model is taken to be right. Of the long-run variance of noise such as VD.3's the first takes more than half,
# the second a third at most (tests/identify/test_noise.py).
SLOW, SLOWER = 15, 75


@dataclass(frozen=True)
class Noise:
    """Noise of one channel in one experiment, at the rate of the reduced data; one row a column of the channel."""

    std: Float[np.ndarray, " columns"]  # of a sample, in the channel's unit
    innovation: Float[np.ndarray, " columns"]  # σ, likewise
    ar: Float[np.ndarray, "columns order"]  # a_k
    source: str  # `repeats`, `holds`, both, or `residuals`

    @classmethod
    def white(cls, std: Float[np.ndarray, " columns"], source: str) -> "Noise":
        """Samples that do not depend on one another."""
        return cls(std, std, np.zeros((len(std), ORDER)), source)

    @property
    def coefficients(self) -> Float[np.ndarray, "columns lags lags"]:
        """The whitening filters [1, −a₁, …] / σ, order + 1 lags; row j predicts from j samples before, as after a gap.

        Levinson's recursion, downwards: a_k ← (a_k + a_j a_{j−k})/(1 − a_j²), σ² ← σ²/(1 − a_j²).
        """
        order = self.ar.shape[1]
        out = np.zeros((len(self.std), order + 1, order + 1))
        a, sigma = self.ar, self.innovation
        for j in range(order, -1, -1):
            out[:, j, : j + 1] = np.concatenate([np.ones((len(a), 1)), -a], axis=1) / sigma[:, None]
            if j:
                last = np.clip(a[:, -1:], -0.99, 0.99)
                a = (a[:, :-1] + last * a[:, -2::-1]) / (1.0 - last**2)
                sigma = sigma / np.sqrt(1.0 - last[:, 0] ** 2)
        return out


def whiten(
    r: Float[Array | np.ndarray, "*more columns B T"],
    mask: Float[Array | np.ndarray, "columns B T"],
    coefficients: Float[Array | np.ndarray, "columns lags lags"],
    demean: bool,
) -> Float[Array | np.ndarray, "*more columns B T"]:
    """White residuals of unit variance, zero where a sample does not count; NumPy's of NumPy's, JAX's of JAX's.

    With `demean`, what a constant per trial and column could explain is projected out (the encoders' arbitrary zero).
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
    """How many samples before each count without a gap, at most `order`."""
    unbroken, total = mask, 0.0 * mask
    for k in range(1, order + 1):
        unbroken = unbroken * _lag(mask, k)
        total = total + unbroken
    return total


def _lag(a: Float[Array | np.ndarray, "*more T"], k: int) -> Float[Array | np.ndarray, "*more T"]:
    """a, k samples later."""
    xp = a.__array_namespace__()
    return xp.concat([xp.zeros_like(a[..., :k]), a[..., :-k]], axis=-1)


def estimate(stack: Stack, channel: str, residual: Float[np.ndarray, "columns B T"], slow: int = SLOW) -> Noise:
    """Noise of a channel from the residuals of a model, by the best source that the stack offers.

    `slow`: samples of the moving average of the residuals that counts as signal where nothing is repeated.
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
        series, source = _fast_part(residual, mask, slow), "residuals"
    # A column with few samples of its own borrows the channel's size, and one with not many its colour, which the
    # filters give to all columns alike.
    own, whole = [_autoregression(c) for c in series], _autoregression([s for column in series for s in column])
    if not own:  # tendons of a machine that has none
        return Noise(np.zeros(0), np.zeros(0), np.zeros((0, *np.shape(whole[2]))), source)
    sizes = [row[0] if _count(c) > FEW else whole[0] for c, row in zip(series, own, strict=True)]
    scaled = [(e / size, m, lost) for c, size in zip(series, sizes, strict=True) for e, m, lost in c]
    unit, spread, colour = _autoregression(scaled)
    rows = [
        row if _count(c) > MANY else (size, size * spread / unit, colour)
        for c, row, size in zip(series, own, sizes, strict=True)
    ]
    std, innovation, ar = (np.array(x) for x in zip(*rows, strict=True))
    if stack.experiment.held:
        scale = _between_holds(_repeats(stack, residual, mask & (stack.holds >= 0), demean), ar, innovation)
        std, innovation = std * scale, innovation * scale
    return Noise(std, innovation, ar, source)


# Values, which of them count, and the share of their covariance that centring has taken from every lag.
Series = list[tuple[np.ndarray, np.ndarray, float]]


def _count(column: Series) -> int:
    return sum(int(m.sum()) for _, m, _ in column)


def _enough(series: list[Series]) -> bool:
    return sum(map(_count, series)) > 100


def _centred(e: np.ndarray, mask: np.ndarray, demean: bool) -> np.ndarray:
    return np.where(mask, e - (e[mask].mean() if demean and mask.any() else 0.0), 0.0)


def _repeats(stack: Stack, residual, mask, demean) -> list[Series]:
    """Residuals about the mean of the trials that repeat one motion, scaled to the noise of a single trial."""
    series: list[Series] = [[] for _ in range(len(residual))]
    motions = [m for m in dict.fromkeys(stack.motions) if m is not None and stack.motions.count(m) > 1]
    for motion in motions:
        members = [b for b, name in enumerate(stack.motions) if name == motion]
        for c, column in enumerate(series):
            both = mask[c, members].all(axis=0)
            if both.sum() < 20:
                continue
            mean = residual[c, members].mean(axis=0)
            scale = np.sqrt(len(members) / (len(members) - 1))
            column += [(_centred(scale * (residual[c, b] - mean), both, demean), both, 0.0) for b in members]
    return series


def _within_holds(stack: Stack, residual, mask) -> list[Series]:
    """Scatter about a straight line through each hold: what creeps or relaxes in it is no noise."""
    series: list[Series] = [[] for _ in range(len(residual))]
    for c, b in np.ndindex(residual.shape[:2]):
        e, counts, lost = np.zeros(residual.shape[2]), np.zeros(residual.shape[2], bool), []
        for hold in stack.samples_of_holds(b, mask[c, b]):
            n = len(hold)
            if n > 5:
                line = np.polyval(np.polyfit(hold, residual[c, b, hold], 1), hold)
                e[hold], counts[hold] = residual[c, b, hold] - line, True
                lost.append(2 / n)
        if counts.any():
            series[c].append((e, counts, float(np.mean(lost))))
    return series


def _between_holds(series: list[Series], ar: np.ndarray, innovation: np.ndarray) -> float:
    """How much more the means of holds scatter between repeats than their samples' noise explains; at least 1.

    A hold's tension is measured with an error of its own, which all samples of the hold share: no scatter within holds
    shows it, and the held joint's torque depends on the tension at holds alone.
    """
    ratios = []
    for column, a, sigma in zip(series, ar, innovation, strict=True):
        covariance = np.fft.irfft(np.abs(sigma / np.fft.rfft(np.r_[1.0, -a], 4096)) ** 2)[:400]  # Wiener–Khinchin
        for e, counts, _ in column:
            for hold in np.ma.clump_unmasked(np.ma.masked_array(e, ~counts)):
                n = min(hold.stop - hold.start, 400)
                expected = (covariance[0] + 2 * ((1 - np.arange(1, n) / n) @ covariance[1:n])) / n
                ratios.append(e[hold].mean() ** 2 / expected)
    return max(1.0, float(np.sqrt(np.mean(ratios)))) if len(ratios) > 20 else 1.0


def _fast_part(residual, mask, slow: int) -> list[Series]:
    """Residuals less their moving average: without repeats, what a law could explain is taken to be slow."""
    series: list[Series] = [[] for _ in range(len(residual))]
    for c, b in np.ndindex(residual.shape[:2]):
        e, counts = np.where(mask[c, b], residual[c, b], 0.0), mask[c, b]
        if counts.any():
            near, share = (uniform_filter1d(x, slow, mode="constant") for x in (e, counts.astype(float)))
            mean = near / np.maximum(share, 1.0 / slow)
            series[c].append((np.where(counts, e - mean, 0.0), counts, 1 / slow))
    return series


def _autoregression(series: Series) -> tuple[float, float, np.ndarray]:
    """Standard deviation, innovation and coefficients by Yule–Walker, robust to a few outliers."""
    if not series or not any(m.any() for _, m, _ in series):
        return 1.0, 1.0, np.zeros(ORDER)
    values = np.concatenate([e[m] for e, m, _ in series])
    limit = 4.0 * 1.4826 * np.median(np.abs(values)) + 1e-300
    clipped = [(np.clip(e, -limit, limit), m, lost) for e, m, lost in series]
    covariance = np.array([_lagged(clipped, k) for k in range(ORDER + 1)])
    if covariance[0] <= 0:
        return 1e-12, 1e-12, np.zeros(ORDER)
    covariance[0] *= 1.0 + 1e-6
    ar = scipy.linalg.solve_toeplitz(covariance[:-1], covariance[1:])
    innovation = covariance[0] - ar @ covariance[1:]
    if not 0 < innovation <= covariance[0] * 1.001:
        return float(np.sqrt(covariance[0])), float(np.sqrt(covariance[0])), np.zeros(ORDER)
    return float(np.sqrt(covariance[0])), float(np.sqrt(innovation)), ar


def _lagged(series: Series, k: int) -> float:
    """Autocovariance at lag k, with what centring took given back: removing d fitted terms from n white samples
    takes a share d/n of the variance from every lag."""
    total = count = back = 0.0
    for e, m, lost in series:
        both = m[k:] & m[: m.size - k]
        n = int(both.sum())
        total, count = total + float(np.sum(e[k:][both] * e[: e.size - k][both])), count + n
        back += n * lost * float(np.mean(e[m] ** 2)) / max(1e-9, 1 - lost) if n else 0.0
    return (total + back) / count if count else 0.0
