"""What docs/NUMERICS.md says of each case, beside its figures."""

from typing import NamedTuple


class Description(NamedTuple):
    """For which inputs a formula is promised; where float32 would overflow, underflow or cancel, and what the code does
    there; the inputs tried, in words."""

    domain: str
    hazard: str
    answer: str
    tried: str


# By formula.
DESCRIPTIONS = {
    "γ(x) = sin, cos of 2ᵏπx, k < 16": Description(
        domain="|x| ≤ 1e30",
        hazard="float32 of 2⁹πx is off by 1e-4 for |x| < 1, by all of it beyond 1e4",
        answer="2ᵏx is reduced to half a turn, exactly in binary, before it is multiplied by π",
        tried="|x| < 0.9; 0, 1e-45, 1e-38, ±1/2, ±1, up to 1e3, 1e6, 1e30",
    ),
    "contraction (2 − 1/r) x/r": Description(
        domain="all finite x",
        hazard="r² overflows beyond 1e19; the slope jumps where r = max abs x_i has ties",
        answer="x/r and 1/r only, r ≥ 1; the identity for r ≤ 1, with a continuous slope at 1",
        tried="|x| < 3; 0, 1e-45, 1 and its neighbours, ties, 1e19, 1e30, 3e38",
    ),
    "its inverse y / (m (2 − m))": Description(
        domain="max abs y_i < 2",
        hazard="2 − m cancels; infinite at 2",
        answer="2 − m of two float32 numbers is exact (Sterbenz); callers stay half a cell within the faces",
        tried="|y| < 1.9; 0, 1 and its neighbours, the last number below 2",
    ),
    "normalised device coordinates (x/z, y/z, 1 − 2 n/z)": Description(
        domain="all finite points",
        hazard="infinite at z = 0, folded back behind it",
        answer="z is n/1000 at least: what is before the near plane or behind the camera is far outside of the cube",
        tried="|x| < 3; at infinity, on the near plane, beside and behind the camera",
    ),
    "their inverse, z = 2 n / (1 − z')": Description(
        domain="max abs y_i < 0.9",
        hazard="1 − z' cancels; infinite at the far face",
        answer="1 − z' of two float32 numbers is exact near the far face; callers stay half a cell within it",
        tried="|y| < 0.89; the middle, the near face, half a cell of 128 within the far face",
    ),
    "straight rays through them": Description(
        domain="rays that come before the near plane",
        hazard="the paper's z/(z + t) − 1 cancels far away; 0/0 for rays parallel to the image plane",
        answer="distances over depth, t / z(t): finite in every direction",
        tried="directions up to 45° off the axis, distances of 2.5 to 100; parallel, from far behind, backward, to 1e6",
    ),
    "o + t d": Description(
        domain="finite",
        hazard="cancels where o and t d are long and their sum is short: a camera 1e6 units off sees 0.06 units coarse",
        answer="the scene frame has its region in ±0.9, wherever sfm had it; the vanilla NeRF takes rays in float64",
        tried="|o| < 3, t < 30; t from 0 and 1e-45 to 1e30",
    ),
    "unit coordinates of samples, bounded": Description(
        domain="points of a ray clipped to the box",
        hazard="o + t d cancels as above",
        answer="errors of a float32 point; gradients are sums over a ray's samples, in order, by Warp in float64",
        tried="|o| < 3, t < 30; t from 0 to 1e-45 … 2",
    ),
    "unit coordinates of samples, contracted": Description(
        domain="all finite points",
        hazard="r³ overflows beyond 1e12 in the gradient −2 (r − 1)/r³",
        answer="written in x/r and 1/r",
        tried="|o| < 3, t < 30; t from 0 and 1e-45 to 1e30",
    ),
    "ray–box interval by slabs": Description(
        domain="finite rays that do not run within a face",
        hazard="0/0 for a ray within a face, (±h − o)/0 along an axis",
        answer="a component of 0 becomes the smallest normal number; a ray within a face may count either way, finite",
        tried="|o| < 2; along axes (±0, 1e-45, 1e-38), from inside, from 1000 and 1e6 away, misses, far = 1e30",
    ),
    "t(s) = step s, then step/cone exp(cone s − 1)": Description(
        domain="t ≤ 1e30",
        hazard="exp overflows for s beyond 89/cone",
        answer="the exponent's own rounding, cone s ulp/2, stays: 1e-6 at t = 1000; infinite t is beyond any far",
        tried="s from 0, 1e-45 to 9000 (t = 1e30)",
    ),
    "s(t), its inverse": Description(
        domain="0 ≤ t ≤ 1e37",
        hazard="log of 0; t/t₁ overflows beyond 3e38 t₁",
        answer="the logarithm is taken of max(1, t/t₁)",
        tried="t from 0, 1e-45 to 1e37",
    ),
    "dt = t(s + 1) − t(s)": Description(
        domain="s ≤ 1200 (t ≤ 1200)",
        hazard="a difference of distances: cancels",
        answer="its error is a share of t, not of dt = 0.008 t: 1e-4 of an interval at most, in length, not in place",
        tried="s from 0 to 1200",
    ),
    "stratified samples, even": Description(
        domain="near ≤ far, finite",
        hazard="far − near cancels for a thin shell far away",
        answer="lerp: exact at both ends, monotonic",
        tried="near < 1 < far < 1000; shells of 1e-6, lengths of 0 and 1e30",
    ),
    "stratified samples near (far/near)ᵘ": Description(
        domain="0 < near ≤ far < 3e38 near",
        hazard="far/near overflows",
        answer="not guarded: far/near is below 1e6 in any scene, and the vanilla NeRF takes rays in float64",
        tried="near < 1 < far < 1000; near = 1e-30 with far = 1, near = far",
    ),
    "edges half-way between samples": Description(
        domain="t < 1.7e38",
        hazard="the sum of two samples overflows beyond",
        answer="not guarded: no scene is so large",
        tried="2 < t < 6, t = 0, t = 1e30",
    ),
    "inverse CDF: CDF(t(u)) = u": Description(
        domain="weights ≥ 0 whose sum is below 3e38; below 1e-37 t is in the right bin, coarse within",
        hazard="0/0 for a ray without weight and in empty bins; u = 1 beyond the last bin; thin bins beside dense ones",
        answer="u is scaled to the sum, not the weights by it, and kept below it: bisection never ends in an empty bin",
        tried="weights over six decades; none, equal, spikes of 1e-37 to 1e30 in every bin; u from 0 to 1",
    ),
    "w_i = T_i (1 − exp(−σ_i δ_i)), colour, depth, opacity": Description(
        domain="σ ≥ 0, ascending t",
        hazard="1 − exp(−τ) loses thin media, 1e30 − 1e30 in Σ_{j<i} τ_j, ∞ · 0 in the gradient of an opaque ray",
        answer="exp of minus a running sum, shifted; expm1; an optical depth of ∞ is exactly opaque, its gradient 0",
        tried="σ over six decades; 0, 1e-45, 1e-38 … 1e30, alone and one behind the other",
    ),
    "opacity of thin media": Description(
        domain="σ ≥ 0",
        hazard="1 − exp(−τ) is 0 for τ < 6e-8, and has one digit at 1e-6",
        answer="expm1; autograd takes its slope as 1 + expm1(−τ), which is off by 6e-8 at any transmittance",
        tried="one interval, τ from 0 and 1e-38 to 10",
    ),
    "the same of packed samples, gradient by hand": Description(
        domain="σ ≥ 0, ascending t",
        hazard="as above; differences of running sums over all rays; T g − Σ w g − U G cancels",
        answer="sums in float64 of τ limited to 800, where exp is 0 even there; what is larger or no number is "
        "summed ray by ray, which Warp always does",
        tried="σ over six decades; 0, 1e-45, 1e-38 … 1e30, alone and one behind the other",
    ),
    "occupancy 1 − 2^(−σ/level)": Description(
        domain="σ ≥ 0, level > 0",
        hazard="linear interpolation of σ puts a sharp surface beside the empty vertex; 1 − 2^(−x) loses thin media",
        answer="expm1: bounded by 1, relative precision down to denormal densities",
        tried="σ from 0, 1e-38 to 1e30",
    ),
    "optical depth by trapezoids": Description(
        domain="σ < 1.7e38",
        hazard="the sum of two densities overflows beyond",
        answer="not guarded: densities are at most e¹⁵",
        tried="σ over six decades; 0, 1e-45 … 1e30, alone and one behind the other",
    ),
    "first crossing of a level": Description(
        domain="values < 3e38",
        hazard="(level − v₀)/(v₁ − v₀) is 0/0 on a plateau",
        answer="divides only where v₁ > v₀; infinite where the level is not reached",
        tried="values around the level; steps from 0 to 1e30, onto the level exactly",
    ),
    "distortion ΣΣ w_i w_j |m_i − m_j| + ⅓ Σ w² l": Description(
        domain="weights in [0, 1]",
        hazard="m Σ w − Σ w m cancels for weights close together far out",
        answer="sums in float64; Warp adds up distances between neighbours, so that no large numbers meet",
        tried="steps of 0.2 to 2 % of the distance; rendered weights; all in one interval or two, 1e-4 each",
    ),
    "distortion where steps grow, m = log t": Description(
        domain="weights in [0, 1], t > 0",
        hazard="as above; log of 0; float32 of log t is off by 5e-7, of two neighbours' difference by 1e-4 of it",
        answer="as above; the logarithm is taken of max(1, t/t₁); Warp takes log(b/a) as 2 artanh((b − a)/(b + a))",
        tried="as above",
    ),
    "depth loss Σ w_i |m(t_i) − m(d)| + U |m(far) − m(d)|": Description(
        domain="weights in [0, 1], 0 < d < 1e37; no point where d = 0",
        hazard="log of 0; the difference of logarithms that nearly agree is off by 5e-7",
        answer="the logarithm is taken of max(1, t/t₁); in float64, by Warp as above: no more is lost than by rounding",
        tried="samples 0.2 to 2 % of 768 apart; points among, before and behind them, from 1e-38 to 1e30",
    ),
    "colour loss e², 2 d |e| − d² where |e| > d": Description(
        domain="any e; NaN and ∞ stay so",
        hazard="e² overflows beyond 1e19",
        answer="p (2 e − p) with p = clamp(e, −d, d), half the gradient",
        tried="|e| from 1e-6 to 1; 0, ± d and their neighbours, ± 1e30",
    ),
    "PSNR −10 log₁₀ MSE": Description(
        domain="0 ≤ MSE < ∞; anything else is refused",
        hazard="infinite for equal images",
        answer="100 dB and no more, in float64",
        tried="MSE from 0, 1e-38, 1e-10 to 1e30",
    ),
    "features of points: trilinear means of grid vertices": Description(
        domain="unit coordinates within ±1e6",
        hazard="x R − cell cancels: R ulp(x) of a cell's width, 2e-5 at R = 384; a border point has two cells",
        answer="continuous, so either cell gives the same; a point beyond the border has the nearest",
        tried="[0, 1]³; vertices and faces of all levels and their neighbours in float32, corners, 1e-45",
    ),
    "its gradient with respect to points": Description(
        domain="unit coordinates",
        hazard="jumps where a point changes its cell: there it is one side's",
        answer="the side of the cell that the value is taken from",
        tried="multiples of 2⁻¹³ in [0, 1]³, whose cells are beyond doubt; corners",
    ),
    "its gradient with respect to the table": Description(
        domain="finite",
        hazard="float32 sums of many points' gradients in one row",
        answer="added in the order of the points; a row served by 200 points is off by 200 half ulps at most",
        tried="2000 points of [0, 1]³ and one point 200 times",
    ),
    "background model: sigmoid of its table's features on the unit sphere": Description(
        domain="finite features",
        hazard="levels cancel: a logit is off by half an ulp of the largest feature; 1 − c is 0 beyond 17",
        answer="accepted, as for the colour network: where features are that large, the colour is saturated",
        tried="features of size 1, 0, 1e-38 and 30 in 512 directions",
    ),
    "spherical harmonics up to degree 3": Description(
        domain="unit vectors; their gradient is that of free vectors",
        hazard="5 z² − 1 and its like cancel near their zeros",
        answer="errors are shares of the largest, not of a value near zero",
        tried="directions; the axes, components of 1e-45 and 1e-20",
    ),
    "density exp(min(x, 15))": Description(
        domain="all finite x",
        hazard="exp overflows beyond 88, and its gradient with it",
        answer="x is limited to 15, where 0.001 units already transmit no more than e⁻³⁰⁰⁰; beyond the gradient is 0",
        tried="|x| < 15; −1e30, −200, −88, ±0, around 15, 88, 1e30",
    ),
    "density log(1 + exp(x + shift)) of the vanilla NeRF": Description(
        domain="all finite x",
        hazard="exp overflows beyond 88; 1 + exp(x) loses x < −16",
        answer="log1p; x itself beyond 40; relative precision down to denormal densities",
        tried="|x| < 15; −1e30, −200, −88, ±0, 15, 88, 1e30",
    ),
    "density network: matrix products and ReLU": Description(
        domain="features up to 1e30",
        hazard="sums of 64 products cancel; relu has two slopes at 0",
        answer="always float32 products; errors are shares of the largest output",
        tried="features of size 1, 1e-4, 1e-38, 0, 1e30",
    ),
    "colour network, sigmoid, c (1 − c)": Description(
        domain="geometry features up to 1e30",
        hazard="1 − c is 0 in float32 for logits beyond 17: a saturated colour has no gradient",
        answer="accepted: the true one is below 6e-8; finite for every logit",
        tried="geometry features of size 1, 0, 1e-38, 1e3, 1e30; harmonics of size 1",
    ),
    "Adam that skips entries with zero gradient": Description(
        domain="|g| < 1.8e19: beyond, g² overflows, and the norm of all gradients with it: the step is refused",
        hazard="g² underflows below 1e-19; m / √v is 0/0 for an entry never touched",
        answer="√v is at least 1e-15, not increased by it; 0 stays exactly where it is",
        tried="g over 20 decades; ±0, 1e-45, 1e-38, 1e-30 … 1e18, with and without a past",
    ),
    "vignetting s(exp(mean p − p(u)) s⁻¹(c))": Description(
        domain="unit directions; log gains within ±16",
        hazard="1 − cos θ cancels beside the axis; exp(g) s⁻¹(c) overflows for colours of 1e15",
        answer="|d − axis|² in its place; from one power law to the other, without linear light in between",
        tried="angles to the corner, up to 2 EV; the axis, the corner, behind; black to 1e10; 23 stops",
    ),
}
