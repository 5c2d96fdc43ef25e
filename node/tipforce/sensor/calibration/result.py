"""What a calibration fit hands back: the matrix, its uncertainty, and what speaks for or against it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, floats
from tipforce.errors import InputError
from tipforce.sensor.calibration.distributions import variance_factors


@dataclass(frozen=True, slots=True, eq=False)
class LoadResidual:
    """All rows of one load: how far the fit is from their readings."""

    P_newtons: float
    phi_rad: float
    theta_rad: float
    rows: tuple[int, ...]
    """Indices of the rows used; a row with one gauge left out is among them."""
    mean_strain: FloatArray
    """Mean residual (reading less fit) of each gauge, (n,); NaN for a gauge with no reading that counts."""
    rms_strain: FloatArray
    """Root mean square residual of each gauge, (n,)."""
    rms_newtons: FloatArray
    """Root mean square of the residual as a force, C e, per F1, F2, F3, (3,); NaN without a complete row."""
    leverage: float
    """Largest leverage of its rows: near 1 the fit follows this load whatever it reads."""


@dataclass(frozen=True, slots=True, eq=False)
class Nonlinearity:
    """V = s + q s^2, or s + q s |s|, with s the elastic strain: whichever of the two the rows prefer."""

    per_strain: FloatArray
    """q of each gauge, (n,), 1 per unit strain: 100 is 10 % per 1000 microstrain."""
    half_width: FloatArray
    """Half of its 95 % interval, (n,)."""
    odd: bool
    """True: s |s|, equal in tension and compression; False: s^2."""
    significant: bool
    model_uncertainty: float
    """Relative standard uncertainty of the force at the largest load, pulls and pushes; 0 where not significant."""


@dataclass(frozen=True, slots=True, eq=False)
class Temperature:
    """Coefficients against the mean temperature of the rows: V = (1 + gain dT) A F + offset + offset_per_K dT."""

    reference_degC: float
    lowest_degC: float
    highest_degC: float
    offset_strain_per_K: FloatArray
    """(n,): estimates; they count in the fit where ``offset_fitted``."""
    offset_half_width: FloatArray
    """Half of the 95 % intervals, (n,); NaN where the rows show nothing of it."""
    offset_fitted: bool
    gain_per_K: float
    gain_half_width: float
    gain_fitted: bool


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """One calibration of n gauges from m rows: V = A F + b, and F = C (V - b)."""

    C: FloatArray
    """(3, n), newtons per unit strain: the left inverse of A, weighted by the gauges' noise variances; C A = I."""
    A: FloatArray
    """(n, 3), strain per newton."""
    offset_strain: FloatArray
    """(n,): the offsets at the last row; with a drift, those of that time."""
    C_uncertainty: FloatArray
    """Standard uncertainty of each entry of C, (3, n)."""
    coverage_factor: float
    """Standard uncertainties to either side that make 95 % (Student's t)."""
    noise_covariance_strain2: FloatArray
    """Sigma_V, (n, n): gauge noise of one reading of weight one."""
    residual_covariance_strain2: FloatArray
    """S, (n, n): covariance of the residuals, with what the scatter of load directions adds."""
    N: FloatArray
    """Sum of weight G G^T over the rows used, (4, 4), G = (F, 1); (3, 3) without offset; a drift: at the last row."""
    parameter_covariance: FloatArray
    """Covariance of (A row, offset) of all gauges, (n, 4, n, 4), SI: S (x) N^-1 where every row has the same noise."""
    sigma0: float
    """Size of the residuals in units of what the noise model expects: near 1 where it is right."""
    sigma0_loaded: float
    """sigma0 of the loaded rows alone; NaN without degrees of freedom."""
    sigma0_unloaded: float
    dof: float
    """Rows less unknowns, for each gauge."""
    noise_dof: float
    """Degrees of freedom that the gauge noise is known with: dof, or infinite where it was stated."""
    condition_number: float
    row_equilibrated_condition_number: float
    residual_strain: FloatArray
    """Reading less fit, (m, n), of every row, used or not."""
    distance: FloatArray
    """(m,): Mahalanobis distance of each row from the fit without it."""
    leverage: FloatArray
    """(m,): share of each row in its own fitted value."""
    used: BoolArray
    """(m, n): the readings that the fit rests on."""
    outliers: tuple[int, ...]
    """Rows left out because they disagree with the others (with loss "none": only named, not left out)."""
    saturated: tuple[tuple[int, int], ...]
    """(row, gauge) of readings at the converter's limit, left out."""
    near_limit: tuple[tuple[int, int], ...]
    """(row, gauge) left out as expected within 3 standard deviations of the limit: some of them would bias the fit."""
    loads: tuple[LoadResidual, ...]
    drift: str
    loss: str
    groove_scatter: float
    """Standard deviation of the angle errors of grooves as found, in units of the stated one; 0 where none is."""
    hang_scatter: float
    """The same of the angle errors that are new in every row."""
    hold_out_score: float
    """Sum over rows of the log likelihood by the fit without each, outliers at the border; the larger is the better."""
    lack_of_fit: float = 0.0
    """Variance between loads that rows repeat over the variance among the rows of each, by their residuals; 0 where it
    is 1 within chance."""
    converged: bool = True
    """False: the steps ended before the numbers settled."""
    nonlinearity: Nonlinearity | None = None
    """None where the rows cannot show it."""
    temperature: Temperature | None = None
    """None without temperatures."""

    @property
    def C_interval(self) -> FloatArray:
        """95 % confidence interval of each entry of C, (2, 3, n): lower and upper ends."""
        half = self.coverage_factor * self.C_uncertainty
        return np.stack((self.C - half, self.C + half))

    @property
    def record_covariances(self) -> tuple[FloatArray, FloatArray]:
        """Noise (n, n) and parameter covariance (n, 4, n, 4) for a record, wider by variance_factors()."""
        noise, parameters = variance_factors(self.noise_dof, len(self.A) - 3)
        return noise * self.noise_covariance_strain2, parameters * self.parameter_covariance

    def covariance_F(self, F_newtons: npt.ArrayLike, *, offset_known: bool = False, noise: bool = True) -> FloatArray:
        """Return the covariance of an estimate at F (..., 3): (..., 3, 3), N^2. See covariance_of_estimate()."""
        Sigma = noise * self.noise_covariance_strain2
        return covariance_of_estimate(self.C, Sigma, self.parameter_covariance, F_newtons, offset_known=offset_known)


def covariance_of_estimate(
    C: npt.ArrayLike,
    noise_covariance: npt.ArrayLike,
    parameter_covariance: npt.ArrayLike,
    F_newtons: npt.ArrayLike,
    *,
    offset_known: bool = False,
) -> FloatArray:
    """Return C (Sigma_V + Q(F)) C^T (..., 3, 3), N^2, the covariance of F = C (V - b): Q(F)_kl = G^T cov(row k, row l)
    G, G = (F, 1). offset_known: after a tare the 1 drops out, and its own noise belongs into noise_covariance.

    C: (3, n). noise_covariance: (n, n), strain^2. parameter_covariance: (n, 4, n, 4). F: (..., 3); else InputError."""
    matrix, F = floats("C", C), floats("F", F_newtons)
    n = matrix.shape[-1]
    Sigma = floats("noise_covariance", noise_covariance)
    blocks = floats("parameter_covariance", parameter_covariance)
    if matrix.shape != (3, n) or Sigma.shape != (n, n) or blocks.shape != (n, 4, n, 4) or F.shape[-1:] != (3,):
        raise InputError(
            f"C {matrix.shape}, noise {Sigma.shape}, parameters {blocks.shape}, F {F.shape}: allowed are (3, n), "
            "(n, n), (n, 4, n, 4), (..., 3)"
        )
    G = np.concatenate((F, np.full((*F.shape[:-1], 1), 0.0 if offset_known else 1.0)), axis=-1)
    # The sum over gauges does not depend on F: 4 x 4 products of G then serve any number of samples.
    kernel = np.einsum("ak,kilj,bl->ijab", matrix, blocks, matrix).reshape(16, 9)
    products = (G[..., :, np.newaxis] * G[..., np.newaxis, :]).reshape(*F.shape[:-1], 16)
    Q = (products @ kernel).reshape(*F.shape[:-1], 3, 3)
    # Positive semi-definite for every F where the blocks are, which a calibration checks once: no check of loads here.
    covariance: FloatArray = matrix @ Sigma @ matrix.T + 0.5 * (Q + np.swapaxes(Q, -1, -2))
    return covariance


def kronecker(residual_covariance: npt.ArrayLike, N: npt.ArrayLike) -> FloatArray:
    """Return S (x) N^-1, (n, 4, n, 4), of S (n, n) and N (4, 4) or (3, 3). Raises InputError for shapes, singular N."""
    S, normal = np.asarray(residual_covariance, dtype=np.float64), np.asarray(N, dtype=np.float64)
    if S.ndim != 2 or S.shape[0] != S.shape[1] or normal.shape not in {(3, 3), (4, 4)}:
        raise InputError(f"S {S.shape}, N {normal.shape}: allowed are (n, n) and (4, 4) or (3, 3)")
    inverse = np.zeros((4, 4))
    q = normal.shape[0]
    try:
        inverse[:q, :q] = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        raise InputError("N is singular: the rows that it sums do not determine every unknown") from None
    blocks: FloatArray = np.einsum("kl,ij->kilj", S, inverse)
    return blocks


DIGITS = 9
"""Finer than the node's REAL32 (seven) and what a good calibration knows (four)."""


def to_digits(values: npt.ArrayLike, digits: int = DIGITS, scale: float = 0.0) -> FloatArray:
    """Return ``values`` rounded to ``digits`` of the largest of them, or of ``scale`` if that is larger. All to the
    same place: an entry that is small beside the others is as uncertain as they are."""
    array = np.asarray(values, dtype=np.float64)
    largest = max(float(np.max(np.abs(array), initial=0.0)), scale)
    return np.round(array, digits - 1 - int(np.floor(np.log10(largest)))) if 0.0 < largest < np.inf else array


def matrix_to_digits(C: npt.ArrayLike) -> FloatArray:
    """Return a calibration matrix (3, n), each row (a force) rounded by itself."""
    return np.stack([to_digits(row) for row in np.asarray(C, dtype=np.float64)])


def rounded(fit: Fit) -> Fit:
    """Return the fit with what goes into a file rounded: equal data then give equal files on every machine."""
    per_newton = float(np.max(np.abs(fit.A), initial=0.0))
    matrices = ("noise_covariance_strain2", "residual_covariance_strain2", "parameter_covariance")
    numbers = (
        "coverage_factor", "sigma0", "dof", "noise_dof", "condition_number", "row_equilibrated_condition_number",
    )  # fmt: skip
    others: dict[str, Any] = {name: to_digits(getattr(fit, name)) for name in matrices}
    others |= {name: float(to_digits(getattr(fit, name))) for name in numbers}
    return replace(
        fit,
        C=matrix_to_digits(fit.C),
        offset_strain=to_digits(fit.offset_strain, scale=per_newton),  # an offset near 0 is as uncertain as others
        C_uncertainty=matrix_to_digits(fit.C_uncertainty),
        # The parameter covariance is computed from the inverse of N, which enlarges what rounding takes away.
        N=to_digits(fit.N, 12),
        **others,
    )
