"""Covariances of estimates, corrected such that their 95 % ellipsoids contain the truth in 95 % of problems.

An estimate minimises a cost, the sum over measurements i of negative log-likelihoods with gradients g_i and
Hessians H_i at the minimum. The inverse Hessian is too small as a covariance, for five reasons.

1. The model of the noise is approximate. The sandwich A^-1 (sum g_i g_i^T) A^-1 holds whatever the noise is (P.
   Huber, Proc. Fifth Berkeley Symposium, 1967; H. White, Econometrica 1980), with each g_i divided by the root of
   1 - h_i, because the fit reduces its residual (HC2: J. MacKinnon, H. White, J. Econometrics 1985), h_i = tr
   (H^-1 H_i) being the leverage of the measurement. From few measurements it is itself uncertain: ``shrunk``
   shrinks it towards a multiple of the inverse information, by an amount that depends on its scatter (O. Ledoit,
   M. Wolf, J. Multivariate Analysis 2004). Along each axis the larger one of it and of the inverse information is
   stated (``larger``).
2. Few measurements carry the information. With leverages that add up to p, their effective number is K = p^2 / sum
   h_i^2 (L. Kish, Survey Sampling, 1965). With a covariance from K samples, normalised squared errors follow the
   T^2 distribution of H. Hotelling (Annals of Mathematical Statistics 1931), not chi-squared;
   ``small_sample_factor`` is the ratio of their quantiles, so that the 95 % ellipsoid of chi-squared covers 95 %.
   Smaller ellipsoids (one deviation) cover slightly more than their level. A sandwich that was shrunk by the
   factor r has the scatter of K / r^2 samples.
3. Neighbouring measurements have common errors. The sandwich over tiles of the image as clusters (K.-Y. Liang, S.
   Zeger, Biometrika 1986) has few degrees of freedom, so that it is summarised by one number: its mean variance
   over that of independent measurements, at least 1 (``shared_error_factor``). It multiplies covariances, and it
   divides log-likelihoods where hypotheses are compared (P. McCullagh, J. Nelder, Generalized Linear Models, 1989,
   9.2: quasi-likelihood; R. Royall, T.-S. Tsou, J. Royal Statistical Society B 2003).
4. Errors do not average out. Positions of image features have a bias of some hundredths of a pixel that depends on
   their subpixel phase and on the texture (M. Shimizu, M. Okutomi, ICCV 2001). The matches of a region share it,
   so a fit to many good matches follows it without visible residuals. ``common_shifts`` adds the effect of shifts
   by ``SHIFT_PX`` of all matches in a tile, for each view and axis separately.
5. The hypothesis itself is uncertain. The covariance of a mixture adds the squared distances between the estimates
   under the hypotheses, weighted by their probabilities (``spread_about``; J. Hoeting, D. Madigan, A. Raftery, C.
   Volinsky, Statistical Science 1999, eq. 3). A motion may also depart from all motion models;
   ``capture.two_frame_spline.departure`` adds the effect of shakes that the matches may hide.

A likelihood that is far from Gaussian (a bound, two optima, a long tail) is not represented.

Each stated number is meant as one standard deviation of the error against the truth, and each covariance C is made
for errors e with e^T C^-1 e below the 95 % quantile of chi-squared in 95 of 100 problems; how often that holds is
measured in docs/explanation/deviations.md. Errors of given values (calibration, shutter) are not included; if
these are estimated, the caller adds their effect.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from rsbench.core.so3 import FloatArray

LEVEL = 0.95
"""Coverage of the ellipsoids."""
TILES = (4, 3)
"""Columns of the image, and rows in each, in which measurements may have common errors."""
FEWEST_PER_PARAMETER = 3.0
"""Smallest K / p for which a covariance should be stated; with less, most matches may be undetected outliers."""
SHIFT_PX, _SHIFT_SHARE = 0.006, 0.1
"""Standard deviation of the shift that the matches of a tile share in one view, pixels, and its largest share of
the standard deviation of a match. The shift was chosen for the log score of the frames of the track pose-1, whose
score does not depend on the share; that was chosen on 45 pairs of ``laws`` with seed 7."""
_LEAST_FREEDOM = 3.0
"""Lower bound of the degrees of freedom of the denominator of F; with fewer, its quantiles are extreme."""
_MOST_FOLLOWED = 0.5
"""Upper bound of leverages in the HC2 correction."""
_LEAST_LEFT = 1e-3
"""Lower bound of the factor r of a shrunk sandwich; below it the degrees of freedom are practically unlimited."""


@dataclass(frozen=True, eq=False)
class Stated:
    """A stated covariance and its ingredients."""

    covariance: FloatArray
    """(p, p), all factors included."""
    count: float = np.inf
    """K, the effective number of measurements."""
    shared: float = 1.0
    """Ratio of the variance with common errors of neighbours to that with independent errors; at least 1."""
    shifted: FloatArray | float = 0.0
    """(p, p) contribution of ``common_shifts``."""

    @property
    def by_shifts(self) -> float:
        """Mean ratio of the variance with ``common_shifts`` to that without; at least 1."""
        if not np.any(self.shifted):
            return 1.0
        size = np.sqrt(np.diagonal(self.covariance))
        whole, shifted = (each / np.outer(size, size) for each in (self.covariance, np.asarray(self.shifted)))
        return 1.0 + float(np.trace(np.linalg.pinv(whole - shifted, hermitian=True) @ shifted)) / len(size)


def stated_covariance(
    gradients: FloatArray,
    inverse: FloatArray,
    information: FloatArray,
    leverages: FloatArray,
    places: FloatArray,
    parameters: int,
    shifts: FloatArray | None = None,
    sigma_px: float = 0.0,
) -> Stated:
    """Compute a covariance with corrections 1 to 4 above, for n measurements and an estimate of size p.

    Args:
        gradients: (n, p) gradients g_i of the cost at its minimum.
        inverse: (p, p) A^-1, inverse of the cost's Hessian.
        information: (p, p) inverse of the expected information: covariance if the model of the noise holds.
        leverages: (n,) h_i.
        places: (n, 2) position of each measurement in the image, in any unit.
        parameters: number of parameters that the measurements determine, p or fewer.
        shifts: (k, n, p) derivatives of g_i by k kinds of shift, per pixel; None leaves out correction 4.
        sigma_px: standard deviation of a measurement.
    """
    kept = np.sqrt(1.0 - np.minimum(leverages, _MOST_FOLLOWED))
    shares = gradients / kept[:, None] @ inverse
    sandwich, left = shrunk(shares, information)
    covariance = larger(sandwich, information)
    groups, count = tiles(places), effective_count(leverages)
    shared = shared_error_factor(shares, groups, covariance, parameters)
    covariance = covariance * shared * small_sample_factor(count / max(left, _LEAST_LEFT) ** 2, parameters)
    shifted = np.zeros_like(covariance) if shifts is None else common_shifts(shifts @ inverse, groups, sigma_px)
    return Stated(covariance=covariance + shifted, count=count, shared=shared, shifted=shifted)


def common_shifts(shares: FloatArray, groups: NDArray[np.int64], sigma_px: float) -> FloatArray:
    """Return the covariance (p, p) due to shifts common to the measurements of a tile, point 4 above.

    Args:
        shares: (k, n, p) change of the estimate per pixel of shift of each measurement, for k kinds of shift.
        groups: (n,) tile of each.
        sigma_px: standard deviation of a measurement.
    """
    sums = np.zeros((len(shares), int(groups.max(initial=-1)) + 1, shares.shape[-1]))
    for each, out in zip(shares, sums, strict=True):
        np.add.at(out, groups, each)
    moved = sums.reshape(-1, shares.shape[-1])
    return np.asarray(moved.T @ moved) * min(SHIFT_PX, _SHIFT_SHARE * sigma_px) ** 2


def shrunk(shares: FloatArray, target: FloatArray) -> tuple[FloatArray, float]:
    """Return the shrunk covariance (p, p) of a sum of independent shares (n, p), and the shrinkage factor r.

    In units in which ``target`` is the identity, the second moments S of the shares are shrunk towards a multiple
    of the identity: mu I + r (S - mu I), mu = tr S / p. The factor r minimises the expected squared distance to
    the truth.
    """
    size = np.sqrt(np.diagonal(target))
    half = size[:, None] * np.linalg.cholesky(target / np.outer(size, size))
    scaled = np.linalg.solve(half, shares.T).T
    moments = scaled.T @ scaled
    mean = np.trace(moments) / len(moments) * np.eye(len(moments))
    scatter = np.sum(np.sum(scaled**2, axis=1) ** 2) - np.sum(moments**2) / max(len(shares), 1)
    distance = np.sum((moments - mean) ** 2)
    left = max(0.0, 1.0 - float(scatter / distance)) if distance > 0.0 else 0.0
    return half @ (mean + left * (moments - mean)) @ half.T, left


def larger(covariance: FloatArray, other: FloatArray) -> FloatArray:
    """Return the larger of two covariances (p, p) along each axis of their joint diagonalisation.

    ``other`` must be positive definite.
    """
    size = np.sqrt(np.diagonal(other))
    half = size[:, None] * np.linalg.cholesky(other / np.outer(size, size))
    back = np.linalg.solve(half, np.linalg.solve(half, covariance).T)
    values, vectors = np.linalg.eigh(0.5 * (back + back.T))
    axes = half @ vectors * np.sqrt(np.maximum(values, 1.0))
    return np.asarray(axes @ axes.T)


def effective_count(leverages: FloatArray) -> float:
    """Return K, the effective number of measurements with leverages (n,); 0 without measurements."""
    squares = float(np.sum(leverages**2))
    return float(np.sum(leverages)) ** 2 / squares if squares > 0.0 else 0.0


@functools.lru_cache(maxsize=4096)
def small_sample_factor(count: float, parameters: int, level: float = LEVEL) -> float:
    """Return the quantile of Hotelling's T^2 for a covariance from K samples, divided by that of chi-squared."""
    freedom = max(float(count) - parameters + 1.0, _LEAST_FREEDOM)
    quantile = float(scipy.special.fdtri(parameters, freedom, level))
    normal = 2.0 * float(scipy.special.gammaincinv(0.5 * parameters, level))
    return (freedom + parameters - 1.0) / freedom * parameters * quantile / normal


def variance_factor(freedom: float, parameters: int, level: float = LEVEL) -> float:
    """Return ``small_sample_factor`` for the case that one variance is estimated, with this freedom."""
    quantile = float(scipy.special.fdtri(parameters, max(freedom, _LEAST_FREEDOM), level))
    return parameters * quantile / (2.0 * float(scipy.special.gammaincinv(0.5 * parameters, level)))


def tiles(places: FloatArray, shape: tuple[int, int] = TILES) -> NDArray[np.int64]:
    """Return the index (n,) of the tile of each place (n, 2); tiles have (almost) the same number of places."""
    columns, rows = shape
    ranks = np.argsort(np.argsort(places[:, 0], kind="stable"), kind="stable")
    column = ranks * columns // max(len(places), 1)
    order = np.lexsort((places[:, 1], column))
    start = np.searchsorted(column[order], np.arange(columns))
    size = np.diff(np.append(start, len(places)))
    inside = np.zeros(len(places), dtype=np.int64)
    inside[order] = np.arange(len(places)) - start[column[order]]
    return np.asarray(column * rows + inside * rows // np.maximum(size[column], 1), dtype=np.int64)


def clustered(shares: FloatArray, groups: NDArray[np.int64]) -> FloatArray:
    """Return the covariance (p, p) of the sum of shares (n, p), measurements' effects, with independent groups."""
    _, places = np.unique(groups, return_inverse=True)
    count = int(places.max(initial=-1)) + 1
    if count < 2:
        return np.zeros((shares.shape[1],) * 2)
    centred = shares - np.mean(shares, axis=0)
    sums = np.stack([np.bincount(places, column, count) for column in centred.T], axis=1)
    return np.asarray(sums.T @ sums) * count / (count - 1)


def shared_error_factor(
    shares: FloatArray, groups: NDArray[np.int64], covariance: FloatArray, parameters: int
) -> float:
    """Return phi, the mean ratio of the variance with errors common to groups to a covariance; at least 1."""
    if not shares.size:
        return 1.0
    size = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    scaled = clustered(shares / size, groups)
    inverse = np.linalg.pinv(covariance / np.outer(size, size), hermitian=True)
    return max(1.0, float(np.trace(inverse @ scaled)) / parameters)


def tempered(probabilities: ArrayLike, factor: float) -> FloatArray:
    """Return the probabilities of hypotheses (k,) after dividing their log-odds by ``factor``."""
    powers = np.asarray(probabilities, dtype=np.float64) ** (1.0 / factor)
    return np.asarray(powers / np.sum(powers))


def spread_about(used: FloatArray, probabilities: ArrayLike, values: FloatArray) -> FloatArray:
    """Return the mean outer product (p, p) of deviations of hypotheses' values (k, p) from the one used."""
    away = np.asarray(values) - used
    return np.asarray((np.asarray(probabilities)[:, None] * away).T @ away)
