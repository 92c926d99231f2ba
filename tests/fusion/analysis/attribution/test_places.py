"""Two campaigns of one machine: what both show repeats."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.attribution import places as module
from fusion.analysis.attribution.correlate import correlate
from fusion.analysis.attribution.places import ComparisonError, compare_places
from tests.fusion import field_simulator as simulator


def maps_of(made):
    return correlate(made.fused, made.field[:, ::2, ::2], draws=99, checks=1)


@pytest.fixture(scope="module")
def first():
    return maps_of(simulator.driven_session(np.random.default_rng(8), source=0))


@pytest.fixture(scope="module")
def both(first):
    """The first session with a second one in which the source drives the axis as much."""
    return compare_places(first, maps_of(simulator.driven_session(np.random.default_rng(9), source=0)))


@pytest.fixture(scope="module")
def alone(first):
    """The first session with a second one in which the source is as warm and drives nothing."""
    quiet = simulator.driven_session(np.random.default_rng(9), source=0, um_per_unit=0.0)
    return compare_places(first, maps_of(quiet))


def joint_of(comparison):
    return next(agreement for agreement in comparison.channels if agreement.channel == "joint")


def far_from_source(place):
    """Distance from the source, cells."""
    return simulator.distance_cells(place.y_mm / 10 - 0.5, place.x_mm / 10 - 0.5, 0)


def test_a_source_that_both_sessions_show_repeats(both):
    joint = joint_of(both)
    assert joint.verdict == "attributable" and joint.p_value <= 0.05
    # 99 simulated series each.
    assert both.least_p == (0.01, 0.01)
    assert far_from_source(joint) <= 7
    assert (both.maps["p_value"].sel(channel="joint") <= 0.05).any()


def test_each_source_is_listed_once_with_what_both_sessions_show(both):
    (repeated,) = [one for one in both.sources if one.repeats]
    assert repeated.shown_by == (0, 1) and repeated.power is None
    assert far_from_source(repeated) <= 5 and max(repeated.p_value) <= 0.05
    # 3 um per 3 K at the source, common and stretch together at the far end: 2 um/K.
    for value, u in zip(repeated.sensitivity_um_per_K, repeated.sensitivity_u_um_per_K, strict=True):
        assert value == pytest.approx(2.0, abs=4 * u)


def test_a_source_of_one_session_is_listed_as_its_own_and_does_not_repeat(alone):
    assert {agreement.verdict for agreement in alone.channels} == {"not attributable"}
    assert joint_of(alone).p_value > 0.05
    sources = alone.sources
    assert {one.shown_by for one in sources} == {(0,)}
    assert min(far_from_source(one) for one in sources) <= 5
    assert all(one.p_value[0] <= 0.05 < one.p_value[1] for one in sources)
    # The second session would have shown the leading one: its silence means something.
    assert sources[0].power > 0.99 and all(0.0 <= one.power <= 1.0 for one in sources)


def test_opposite_signs_do_not_agree(first):
    opposite = simulator.driven_session(np.random.default_rng(9), source=0, um_per_unit=-3.0)
    joint = joint_of(compare_places(first, maps_of(opposite)))
    assert joint.verdict == "not attributable"
    assert joint.sensitivity_um_per_K[0] * joint.sensitivity_um_per_K[1] < 0


def test_two_warm_ups_are_not_separable():
    sessions = [maps_of(simulator.null_session("warm", np.random.default_rng(seed))) for seed in (1, 2)]
    assert {agreement.verdict for agreement in compare_places(*sessions).channels} == {"not separable"}


def pair_of(*sides):
    """Candidates of two sessions by hand, each in one row of cells."""
    return module._Pair({name: np.array([np.atleast_2d(side[name]) for side in sides], float) for name in sides[0]})


def test_other_plans_and_other_channels_are_refused(first):
    with pytest.raises(ComparisonError, match="the plan grids differ along x"):
        compare_places(first, first.isel(x=slice(0, 5)))
    with pytest.raises(ComparisonError, match="share no drift channel"):
        compare_places(first.sel(channel=["common"]), first.sel(channel=["reversal"]))


@pytest.mark.parametrize(
    ("changed", "agrees"),
    [
        ({}, True),
        ({"sensitivity": -2.0}, False),
        ({"p_value": 0.06}, False),
        ({"p_value": 0.05}, True),
        ({"x": 100.0 + 30.0, "y": 50.0 - 40.0}, True),
        ({"sensitivity": 2.0 + 2.9 * np.hypot(0.3, 0.4)}, True),
        ({"sensitivity": 2.0 + 3.1 * np.hypot(0.3, 0.4)}, False),
        ({"x": 100.0 + 49.0}, True),
        ({"x": 100.0 + 40.0, "y": 50.0 + 40.0}, False),
        # Less than three standard uncertainties apart, and of opposite sign.
        ({"sensitivity": -0.01, "sensitivity_u": 4.0}, False),
    ],
)
def test_sessions_agree_with_one_place_one_sign_one_size_and_both_p_values(changed, agrees):
    """Sizes may differ by three standard uncertainties of their difference, places by 50 mm; the larger p-value counts."""
    first = {"p_value": 0.01, "sensitivity": 2.0, "sensitivity_u": 0.3, "x": 100.0, "y": 50.0}
    second = {**first, "p_value": 0.04, "sensitivity_u": 0.4, **changed}
    pair = pair_of(first, second)
    assert bool(pair.agree[0, 0]) is agrees
    assert float(pair.p_value[0, 0]) == second["p_value"]


def test_the_chance_of_the_other_session_follows_from_its_detection_limit():
    other = xr.Dataset({"threshold": 9.0, "detectable_sensitivity": (("y", "x"), [[2.0, np.nan]])})
    assert module._power(2.0, other, (0, 0)) == pytest.approx(0.8)
    assert module._power(-4.0, other, (0, 0)) > 0.999 > 0.05 > module._power(0.5, other, (0, 0))
    assert module._power(2.0, other, (0, 1)) is None


def test_a_place_on_which_both_agree_is_told_apart_from_its_neighbour():
    """One session has its mode 100 mm beside the place on which both agree: both places are listed, and the one names the other."""
    plan = xr.Dataset(coords={"y": np.arange(5.0, 200.0, 10.0), "x": np.arange(5.0, 500.0, 10.0)})
    pair = SimpleNamespace(at=lambda name, row, column: (row, column))
    pairs = {"joint": pair, "common": pair}
    alone = module._source_at(pairs, plan, "joint", (405.0, 75.0), (0,), True)
    agreed = module.ChannelAgreement("joint", "attributable", 345.0, 155.0, 0.004, (4.0, 5.8), (0.0, 0.0))
    first, second = module._with_agreed_places([alone], [agreed], plan, pairs)
    assert (second.x_mm, second.agrees, second.repeats, second.shown_by) == (345.0, True, False, (0, 1))
    assert first.agreed_near_mm == (345.0, 155.0, 100.0) and not first.agrees
    # A place that repeats already, be it in another part of the drift, is not listed a second time.
    repeated = module._source_at(pairs, plan, "common", (345.0, 105.0), (0, 1), True)
    assert module._with_agreed_places([repeated], [agreed], plan, pairs) == [repeated]
    # One elsewhere hides nothing.
    far = module._source_at(pairs, plan, "common", (290.0, 155.0), (0, 1), True)
    assert [one.x_mm for one in module._with_agreed_places([far], [agreed], plan, pairs)] == [290.0, 345.0]


def session_by_hand(mode_statistic=30.0):
    """One channel, threshold 10; cells of 10 mm, one of them never seen; one thermal mode, threshold 20, with its peak in cell (1, 2)."""
    statistic = np.full((3, 4), 2.0)
    statistic[0, 0] = np.nan
    dims = ("channel", "y", "x")
    cells = {
        "statistic": (dims, statistic[None]),
        "p_value": (dims, 0.25 * statistic[None]),
        "sensitivity": (dims, 0.05 * statistic[None]),
        "sensitivity_u": (dims, 0.1 * statistic[None]),
        "sensitivity_low": (dims, -0.2 * statistic[None]),
        "sensitivity_high": (dims, 0.3 * statistic[None]),
        "lag": (dims, 300.0 * statistic[None]),
        "threshold": ("channel", [10.0]),
    }
    of_mode = {"statistic": mode_statistic, "p_value": 0.01, "sensitivity": 3.0, "sensitivity_u": 0.4}
    of_mode |= {"sensitivity_low": 1.8, "sensitivity_high": 4.2, "lag": 1200.0, "threshold": 20.0}
    modes = {name: (("channel", "mode"), [[value]]) for name, value in of_mode.items()}
    places = {"at_x": ("mode", [26.0]), "at_y": ("mode", [14.0])}
    plan = xr.Dataset(cells, {"channel": ["joint"], "y": [5.0, 15.0, 25.0], "x": [5.0, 15.0, 25.0, 35.0]})
    return xr.DataTree(plan, children={"modes": xr.DataTree(xr.Dataset(modes | places, {"channel": ["joint"]}))})


def test_the_candidate_of_a_cell_is_itself_or_the_mode_that_has_its_peak_there():
    found = module._candidates(session_by_hand(), "joint")
    assert found["statistic"].tolist() == [[-0.1, 0.2, 0.2, 0.2], [0.2, 0.2, 1.5, 0.2], [0.2, 0.2, 0.2, 0.2]]
    of_mode = [
        float(found[name][1, 2]) for name in ("p_value", "sensitivity", "sensitivity_low", "sensitivity_high", "lag")
    ]
    assert of_mode == [0.01, 3.0, 1.8, 4.2, 1200.0]
    assert (found["p_value"][0, 0], found["sensitivity"][0, 0], found["sensitivity_u"][0, 0]) == (1.0, 0.0, np.inf)
    assert (found["x"][1, 2], found["y"][1, 2]) == (25.0, 15.0)
    # Maps that an older program made have no limits, and are compared all the same.
    older = session_by_hand().map_over_datasets(
        lambda one: one.drop_vars(["sensitivity_low", "sensitivity_high"], errors="ignore")
    )
    limits = module._candidates(older, "joint")
    assert np.isneginf(limits["sensitivity_low"]).all() and np.isposinf(limits["sensitivity_high"]).all()
    # A mode below its threshold by more than the cell is leaves the cell as it is.
    assert module._candidates(session_by_hand(3.0), "joint")["p_value"][1, 2] == 0.5


def test_a_session_without_modes_has_its_cells(monkeypatch):
    plan = session_by_hand().to_dataset()
    found, none = (xr.DataTree(plan.assign_attrs(verdict=verdict)) for verdict in ("attributable", "not attributable"))
    assert module._candidates(found, "joint")["p_value"][1, 2] == 0.5
    monkeypatch.setattr(
        module, "find_source", lambda session: SimpleNamespace(kind="cell", part="joint", x_mm=5.0, y_mm=15.0)
    )
    assert module._sources_of(found) == [("joint", 5.0, 15.0, True)]
    assert module._sources_of(none) == []


def test_every_mode_that_passes_is_a_source_of_the_part_of_the_drift_that_it_goes_with_most(monkeypatch):
    """Modes: passes in both parts, with 2.5 and 1.9 thresholds; in the second alone, and adds nothing; in none."""
    dims = ("channel", "mode")
    modes = xr.Dataset(
        {
            "statistic": (dims, [[25.0, 40.0, 1.0], [19.0, 12.0, 1.0]]),
            "threshold": ("channel", [10.0, 10.0]),
            "p_value": (dims, [[0.01, 0.06, 0.9], [0.02, 0.05, 0.9]]),
            "p_beside": (dims, [[np.nan, 0.01, 0.9], [0.8, 0.3, 0.9]]),
            "at_x": ("mode", [10.0, 20.0, 30.0]),
            "at_y": ("mode", [1.0, 2.0, 3.0]),
        },
        {"channel": ["common", "joint"]},
    )
    session = xr.DataTree(xr.Dataset(attrs={"verdict": "attributable"}), children={"modes": xr.DataTree(modes)})
    monkeypatch.setattr(module, "find_source", lambda session: SimpleNamespace(kind="mode"))
    # The leading mode has none beside it, and counts as told apart.
    assert module._sources_of(session) == [("common", 10.0, 1.0, True), ("joint", 20.0, 2.0, False)]


def test_a_candidate_is_seen_from_every_cell_within_reach_and_from_no_other():
    reach = 3
    statistic = np.zeros((7, 8))
    statistic[3, 4] = 5.0
    statistic[0, 0] = 1.0
    row, column = np.mgrid[:7, :8]
    blank = {name: np.zeros((7, 8)) for name in module._BLANK if name != "statistic"}
    found = module._strongest_nearby({"statistic": statistic, "x": column, "y": row, **blank}, reach)
    near = np.hypot(row - 3, column - 4) <= reach
    assert ((found["statistic"] == 5.0) == near).all()
    assert (found["x"][near] == 4).all() and (found["y"][near] == 3).all()
    # Of two within reach the stronger one is seen.
    assert found["statistic"][0, 1] == 1.0 and found["statistic"][6, 0] == 0.0


def test_agreement_goes_before_strength_and_is_where_the_weaker_session_is_strongest():
    """Cells: both strong but of unlike size; agreement (5, 2); agreement (3, 4)."""
    shared = {
        "p_value": [0.01] * 3,
        "sensitivity_u": [0.1] * 3,
        "lag": [0.0] * 3,
        "x": [5.0, 15.0, 25.0],
        "y": [5.0] * 3,
    }
    one = shared | {"statistic": [9.0, 5.0, 3.0], "sensitivity": [1.0, 1.0, 1.0]}
    other = shared | {"statistic": [9.0, 2.0, 4.0], "sensitivity": [3.0, 1.0, 1.0], "x": [5.0, 15.0, 35.0]}
    told = module._conclude("joint", pair_of(one, other), True)
    assert (told.verdict, told.x_mm, told.sensitivity_um_per_K) == ("attributable", 30.0, (1.0, 1.0))
