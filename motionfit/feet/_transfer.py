"""The instant at which the weight goes from one vertex to the next, between two frames: thesis 3.1.2.

The speeds of both vertices are Catmull-Rom curves through four frames; where they cross, the weight goes over. The
crossing is the root of a cubic, in closed form after Nickalls, "A new approach to solving the cubic: Cardan's
solution revealed", Math. Gaz. 77 (1993): the cubic is seen from its point of inflexion, where it is odd.
"""

import numpy as np
from jaxtyping import Float


def catmull_rom(points: Float[np.ndarray, "4 *rest"]) -> Float[np.ndarray, "4 *rest"]:
    """Coefficients (of q^3, q^2, q, 1) of the Catmull-Rom segment between the middle two of four points, q in 0..1."""
    a, b, c, d = points
    return np.stack([0.5 * (3 * (b - c) + d - a), a - 2.5 * b + 2 * c - 0.5 * d, 0.5 * (c - a), b])


def evaluate(coefficients: Float[np.ndarray, "4 ..."], q: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """A cubic at q (Horner)."""
    a, b, c, d = coefficients
    return np.asarray(((a * q + b) * q + c) * q + d)


def integral(coefficients: Float[np.ndarray, "4 ..."], q: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """The integral of a cubic from 0 to q."""
    a, b, c, d = coefficients
    return np.asarray((((a / 4 * q + b / 3) * q + c / 2) * q + d) * q)


def cubic_roots(coefficients: Float[np.ndarray, "4 *rest"]) -> Float[np.ndarray, "3 *rest"]:
    """The real roots of a q^3 + b q^2 + c q + d, ascending; NaN where there are fewer. Multiple roots come once.

    With the inflexion at q_n = -b/3a, its value y_n, and the turning points a distance delta to both sides and h
    above and below it (delta^2 = (b^2 - 3ac)/9a^2, h = 2 a delta^3): one real root where y_n^2 > h^2, a double and
    a single one where they are equal, three where y_n^2 < h^2. Falls back to the quadratic and the linear formula
    where the leading coefficients vanish next to the others. An equation that always holds has no single root.
    """
    coefficients = np.asarray(coefficients, float)
    rest = coefficients.shape[1:]
    flat = coefficients.reshape(4, -1)
    roots = np.full((3, flat.shape[1]), np.nan)
    size = np.abs(flat).max(0)
    # on the interval 0..1 a leading coefficient this much smaller than the rest moves no root by more than rounding
    tiny = 1e-12 * size
    cubic = np.abs(flat[0]) > tiny
    quadratic = ~cubic & (np.abs(flat[1]) > tiny)
    linear = ~cubic & ~quadratic & (np.abs(flat[2]) > tiny)
    if cubic.any():
        roots[:, cubic] = _nickalls(flat[:, cubic])
    if quadratic.any():
        roots[:2, quadratic] = _quadratic(flat[1:, quadratic])
    roots[0, linear] = -flat[3, linear] / flat[2, linear]
    found = np.isfinite(roots)
    some = found & cubic
    if some.any():
        # one Newton step takes the rounding of the closed form away; it is skipped at a multiple root
        slope = (3 * flat[0] * roots + 2 * flat[1]) * roots + flat[2]
        value = evaluate(flat, roots)
        safe = some & (np.abs(slope) > 1e-6 * size)
        roots = np.where(safe, roots - value / np.where(safe, slope, 1.0), roots)
    return np.sort(roots, axis=0).reshape(3, *rest)


def _nickalls(flat: Float[np.ndarray, "4 n"]) -> Float[np.ndarray, "3 n"]:
    a, b, c, d = flat
    inflexion = -b / (3 * a)
    height = evaluate(flat, inflexion)  # y_n
    delta_squared = (b * b - 3 * a * c) / (9 * a * a)
    h_squared = 4 * a * a * delta_squared**3
    roots = np.full((3, len(a)), np.nan)
    scale = np.maximum(np.maximum(height**2, np.abs(h_squared)), 1e-300)
    difference = height**2 - h_squared
    turning = delta_squared > 0
    close = turning & (np.abs(difference) <= 1e-13 * scale)
    one = (difference > 0) & ~close
    three = ~one & ~close & turning
    # three real roots: q = q_n + 2 delta cos(theta), cos(3 theta) = -y_n / h
    if three.any():
        delta = np.sqrt(delta_squared[three])
        cosine = np.clip(-height[three] / (2 * a[three] * delta**3), -1.0, 1.0)
        theta = np.arccos(cosine) / 3
        for k in range(3):
            roots[k, three] = inflexion[three] + 2 * delta * np.cos(theta + 2 * np.pi * k / 3)
    if one.any():
        root = np.sqrt(difference[one])
        # the larger of the two cube roots first, the other from their product delta^2: no cancellation
        y = height[one]
        large = np.cbrt((-y - np.copysign(root, y)) / (2 * a[one]))
        small = np.where(large != 0, delta_squared[one] / np.where(large != 0, large, 1.0), 0.0)
        roots[0, one] = inflexion[one] + large + small
    if close.any():
        # the double root lies at the turning point on the side of y_n, the single one twice as far on the other
        step = np.cbrt(height[close] / (2 * a[close]))
        roots[0, close] = inflexion[close] + step
        roots[1, close] = inflexion[close] - 2 * step
    # neither turning points nor a height: the triple root at the inflexion
    rest = ~(one | three | close)
    roots[0, rest] = inflexion[rest]
    return roots


def _quadratic(flat: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "2 n"]:
    a, b, c = flat
    squared = b * b - 4 * a * c
    root = np.sqrt(np.where(squared >= 0, squared, np.nan))
    s = -0.5 * (b + np.copysign(root, b))
    first = s / a
    # b = c = 0 leaves the double root 0; elsewhere the product of the roots gives the second without cancellation
    second = np.where(s != 0, c / np.where(s != 0, s, 1.0), first)
    return np.stack([first, np.where(squared == 0, np.nan, second)])


def transfer_instant(
    speeds_from: Float[np.ndarray, "4 *rest"], speeds_to: Float[np.ndarray, "4 *rest"]
) -> Float[np.ndarray, "*rest"]:
    """q_t in 0..1: when the vertex that stands should stop to, since the next one has become slower.

    `speeds_*` [m/s] are those of both vertices at frames t-1, t, t+1, t+2. Of several crossings the first after
    which the next vertex is the slower one counts. Without a crossing the slower vertex holds the whole step.
    """
    difference = catmull_rom(speeds_from - speeds_to)
    roots = cubic_roots(difference)
    inside = np.isfinite(roots) & (roots >= 0) & (roots <= 1)
    a, b, c, _ = difference
    q = np.where(inside, roots, 0.0)
    rising = inside & ((3 * a * q + 2 * b) * q + c >= 0)
    usable = np.where(rising.any(0), rising, inside)
    first = np.where(usable, roots, np.inf).min(0)
    whole = np.where(evaluate(difference, np.full(difference.shape[1:], 0.5)) > 0, 0.0, 1.0)
    return np.where(np.isfinite(first), first, whole)


def place_at(
    positions: Float[np.ndarray, "4 *rest 3"], speeds: Float[np.ndarray, "4 *rest"], q: Float[np.ndarray, "*rest"]
) -> Float[np.ndarray, "*rest 3"]:
    """Where a vertex is at time t + q [m]: on the Catmull-Rom curve through four frames, at the share
    t_i = (integral of V_i over 0..q) / (integral over 0..1) of its way (thesis 3.1.2)."""
    curve = catmull_rom(speeds)
    whole = integral(curve, np.ones_like(q))
    # a curve through small speeds may dip below zero, and a vertex at rest has no way to take a share of
    fair = whole > 1e-9
    share = np.where(fair, np.clip(integral(curve, q) / np.where(fair, whole, 1.0), 0.0, 1.0), q)
    return evaluate(catmull_rom(positions), share[..., None])
