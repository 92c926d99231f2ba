"""Place and rise of hotspots over their uncertainty, for sources of known shape; hotspots of fields that hold none."""

import numpy as np
import pytest
import xarray as xr
from scipy.special import ndtr

from thermography.fields.hotspots import detect_hotspots

pytestmark = pytest.mark.slow

X = np.arange(140) * 5.0 + 2.5
Y = np.arange(36) * 5.0 + 2.5
SEEDS = (1, 4_164_494_896)
FINE = 8
COUNT = 60


def cells(function):
    """Means over cells of 5 mm of a function of x and y in mm, each over 8 x 8 points."""
    x, y = ((np.arange(FINE * n) + 0.5) * 5.0 / FINE for n in (140, 36))
    return function(x[None, :], y[:, None]).reshape(36, FINE, 140, FINE).mean(axis=(1, 3))


def gaussian(x0, y0, height, width, across=None, angle=0.0):
    across = width if across is None else across
    c, s = np.cos(angle), np.sin(angle)

    def values(x, y):
        along, beside = c * (x - x0) + s * (y - y0), c * (y - y0) - s * (x - x0)
        return height * np.exp(-0.5 * (along**2 / width**2 + beside**2 / across**2))

    return values


def scene(kind, rng):
    """Field of one source, (y, x), and where its peak is: x and y in mm, rise in K."""
    x0, y0, height = rng.uniform(150, 550), rng.uniform(50, 130), rng.uniform(1.0, 3.0)
    if kind.startswith("gaussian"):
        return cells(gaussian(x0, y0, height, float(kind.split()[1]))), (x0, y0, height)
    if kind == "elliptic":
        return cells(gaussian(x0, y0, height, 40.0, 15.0, rng.uniform(0, np.pi))), (x0, y0, height)
    if kind in ("on a slope", "two, 50 mm apart"):
        source, beside = gaussian(x0, y0, height, 30.0), lambda x, y: 2.0 / 700.0 * x
        if kind != "on a slope":
            source, beside = gaussian(x0, y0, height, 15.0), gaussian(x0 + 50.0, y0, 0.8 * height, 15.0)
        along = x0 + np.linspace(-2.0, 20.0, 22001)
        values = source(along, y0) + beside(along, y0)
        at = int(np.argmax(values))
        return cells(lambda x, y: source(x, y) + beside(x, y)), (along[at], y0, float(values[at]))
    if kind == "exponential":
        return cells(lambda x, y: height * np.exp(-np.hypot(x - x0, y - y0) / 30.0)), (x0, y0, height)
    if kind == "rectangle":
        # 120 x 20 mm, turned, with edges that heat has blurred by 8 mm: the peak may lie anywhere along it.
        c, s = np.cos(turn := rng.uniform(0, np.pi)), np.sin(turn)

        def values(x, y):
            along, beside = c * (x - x0) + s * (y - y0), c * (y - y0) - s * (x - x0)
            inside = (ndtr((60 - along) / 8) - ndtr((-60 - along) / 8)) * (
                ndtr((10 - beside) / 8) - ndtr((-10 - beside) / 8)
            )
            return height * inside

        return cells(values), (x0, y0, height * (2 * ndtr(60 / 8) - 1) * (2 * ndtr(10 / 8) - 1))
    if kind == "flat disc":
        return cells(lambda x, y: height * (np.hypot(x - x0, y - y0) < 25.0)), (x0, y0, height)
    assert kind == "at the edge"
    # On the last 30 mm of the table, or up to 10 mm beyond it: then the edge is the warmest.
    x0 = rng.uniform(670.0, 710.0)
    source = gaussian(x0, y0, height, rng.uniform(15.0, 60.0))
    return cells(source), (min(x0, 700.0), y0, float(source(min(x0, 700.0), y0)))


def field(values):
    return xr.DataArray(values, dims=("cycle", "y", "x")[-values.ndim :], coords={"y": Y, "x": X})


#: How many hotspots a scene may show: the upper end of a slope is one where it stands out.
COUNTS = {"on a slope": (1, 2), "two, 50 mm apart": (2,)}
#: How far from the middle of a source the peak may be found, where not 25 mm.
REACH_MM = {"rectangle": 65.0}
#: Smallest and largest root mean square of error over uncertainty, 0.7 and 1.4 widened by twice their own standard deviation and, below,
#: by what other shapes add to u; a shape that is no Gaussian only has an upper limit.
KINDS = {
    **{f"gaussian {width}": (0.55, 1.6) for width in (6, 10, 30, 60)},
    "elliptic": (0.45, 1.6),
    "on a slope": (0.3, 1.6),
    **dict.fromkeys(("two, 50 mm apart", "at the edge"), (0.0, 1.6)),
    # The cusp of an exponential is narrower than a cell; noise on a plateau is taken for a narrow peak in none to two of 60.
    **dict.fromkeys(("exponential", "flat disc", "rectangle"), (0.0, 2.0)),
}


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_errors_are_as_large_as_their_uncertainty(kind, seed):
    """60 sources each in noise of 14 or 40 mK: a root mean square of normal values is known to 9 %."""
    rng = np.random.default_rng([seed, *kind.encode()])
    over, sizes, missed = [], [], 0
    for k in range(COUNT):
        clean, truth = scene(kind, rng)
        spots = detect_hotspots(field(clean + rng.normal(0, (0.014, 0.04)[k % 2], clean.shape)))
        near = [
            spot for spot in spots if np.hypot(spot.x_mm - truth[0], spot.y_mm - truth[1]) < REACH_MM.get(kind, 25.0)
        ]
        missed += not near or len(spots) not in COUNTS.get(kind, (1,))
        if near:
            spot = near[0]
            u = np.array([spot.x_u_mm, spot.y_u_mm, spot.peak_rise_u_K])
            over.append((np.array([spot.x_mm, spot.y_mm, spot.peak_rise_K]) - truth) / u)
            sizes.append(u)
    rms, largest, u = np.sqrt(np.mean(np.square(over), axis=0)), np.abs(over).max(axis=0), np.median(sizes, axis=0)
    beyond = (np.abs(over) > 2).mean(axis=0)
    print(
        f"{kind}, seed {seed}: rms {rms.round(2)}, above 2: {beyond.round(3)}, largest {largest.round(1)}, "
        f"u {u.round(3)}, missed {missed}"
    )
    low, high = KINDS[kind]
    assert missed <= 0.02 * COUNT
    assert (rms < high).all() and (rms > low).all()
    assert (beyond < 0.2).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_noise_makes_no_hotspot(seed):
    """200 fields of noise, 40 stacks of 40 cycles of it, and 10 such stacks of one source that warms up."""
    rng = np.random.default_rng(seed)
    in_fields = sum(len(detect_hotspots(field(rng.normal(0, 0.2, (36, 140))))) for _ in range(200))
    in_stacks = sum(len(detect_hotspots(field(rng.normal(0, 0.2, (40, 36, 140))))) for _ in range(40))
    beside = 0
    for _ in range(10):
        source = cells(gaussian(rng.uniform(150, 550), rng.uniform(50, 130), 1.5, 30.0))
        warming = (1 - np.exp(-np.arange(40) / 15.0))[:, None, None] * source
        beside += len(detect_hotspots(field(warming + rng.normal(0, 0.2, warming.shape)))) - 1
    print(
        f"seed {seed}: false hotspots {in_fields} in 200 fields, {in_stacks} in 40 stacks, {beside} beside 10 sources"
    )
    # 200 fields without one bound the rate below 1.5 % (95 %).
    assert in_fields <= 1 and in_stacks <= 1 and beside == 0
