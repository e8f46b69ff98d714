"""Sine and cosine together, by polynomials that a processor computes for many angles at once.

XLA calls the C library for each sine in double precision, one angle at a time, which takes up to half of the inverse
dynamics of a chain. The reduction is that of Cody and Waite (1980). The polynomials are those of FreeBSD's math library
(msun, k_sin and k_cos), with errors below 2⁻⁵⁷ on [−π/4, π/4].
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_QUARTER_TURN = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)  # π/2 in parts of 33 bits
# Coefficients of rising powers of r²: sin r = r + r³ S(r²), cos r = 1 − r²/2 + r⁴ C(r²).
_SINE = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
    2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
_COSINE = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
    -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip


@jax.custom_jvp
def sin_cos(angle: Float[Array, "*T"]) -> tuple[Float[Array, "*T"], Float[Array, "*T"]]:
    """sin and cos of an angle, rad, to 2⁻⁵² for angles up to 10⁵."""
    quarters = jnp.round(angle * (2.0 / jnp.pi))
    first, second, third = _QUARTER_TURN
    r = ((angle - quarters * first) - quarters * second) - quarters * third
    rr = r * r
    s = r + r * rr * _polynomial(_SINE, rr)
    c = 1.0 - 0.5 * rr + rr * rr * _polynomial(_COSINE, rr)
    quadrant = quarters - 4.0 * jnp.floor(0.25 * quarters)
    odd = (quadrant == 1.0) | (quadrant == 3.0)
    sine, cosine = jnp.where(odd, c, s), jnp.where(odd, s, c)
    return (
        jnp.where(quadrant >= 2.0, -sine, sine),
        jnp.where((quadrant == 1.0) | (quadrant == 2.0), -cosine, cosine),
    )


@sin_cos.defjvp
def _sin_cos_jvp(primals, tangents):
    (angle,), (change,) = primals, tangents
    s, c = sin_cos(angle)
    return (s, c), (c * change, -s * change)


def _polynomial(coefficients, x):
    """Horner's rule, coefficients of rising powers."""
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = coefficient + x * value
    return value
