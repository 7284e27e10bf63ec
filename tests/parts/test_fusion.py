"""Forest and CAD as one probability: its weights, its laws and what is unknown."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.parts.forest_and_cad import Fusion, Judged, measure_fusion

NAMES = ("block", "rod", "wedge")


def judged(seed: int = 0, count: int = 300, points: int = 1000, forest: float = 2.0) -> Judged:
    """Scans of which forest and CAD know the class with independent noise."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(3, size=count)
    truth = np.eye(3)[labels]
    logits = forest * truth + rng.normal(size=(count, 3)) * 1.5
    shares = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    misfit = np.exp(rng.normal(np.log(30) + 0.5 * (1 - truth), 0.3))
    familiar = rng.random(count)
    agreed = np.stack([misfit, np.full_like(misfit, 0.001), np.zeros_like(misfit)], axis=2)
    posed = np.full(count, True)
    return Judged(NAMES, labels, np.full(count, points), shares, familiar, agreed, misfit, posed)


def answers(fusion: Fusion, scans: Judged) -> np.ndarray:
    rows = zip(scans.forest, scans.agreed, scans.points.tolist(), strict=True)
    return np.stack([fusion.probabilities(*row) for row in rows])


def alike(*misfit: float) -> np.ndarray:
    """Misfits, with a residual and a view that are alike for all."""
    known = np.isfinite(misfit)
    return np.stack([misfit, np.where(known, 0.001, np.nan), np.where(known, 0.3, np.nan)], axis=1)


def test_both_together_are_right_more_often_than_either() -> None:
    fusion, others = measure_fusion(judged(0)), judged(1)
    both = (answers(fusion, others).argmax(axis=1) == others.labels).mean()
    for alone in (others.forest, -others.agreed[:, :, 0]):
        assert both > (alone.argmax(axis=1) == others.labels).mean() + 0.03


def test_confidence_is_the_share_that_is_right() -> None:
    fusion, others = measure_fusion(judged(0)), judged(1, count=3000)
    shares = answers(fusion, others)
    right = shares.argmax(axis=1) == others.labels
    assert shares.max(axis=1).mean() == pytest.approx(right.mean(), abs=0.02)


def test_few_scans_that_the_simulation_spoilt_do_not_silence_the_cad() -> None:
    """Their own CAD agrees far worse than others."""
    scans = judged()
    spoilt = np.flatnonzero(np.arange(len(scans.labels)) % 20 == 0)
    agreed = scans.agreed.copy()
    agreed[spoilt, scans.labels[spoilt], 0] = 300
    fusion = measure_fusion(replace(scans, agreed=agreed))
    assert fusion.witness > 0.6 * measure_fusion(scans).witness


def test_a_witness_that_knows_nothing_gets_no_weight() -> None:
    scans = judged()
    noise = np.exp(np.random.default_rng(5).normal(0, 0.3, scans.agreed.shape)) * (30, 0.001, 1)
    fusion = measure_fusion(Judged(**{**vars(scans), "agreed": noise}))
    # The one that knows the class has the weight, whichever it is.
    knows = scans.agreed[:, :, [1, 0, 2]] * (30e3, 1e-3 / 30, 0)
    assert (knows[:, :, 0] == 30).all()
    swapped = measure_fusion(Judged(**{**vars(scans), "agreed": knows}))
    usual = Fusion()
    assert swapped.residual / usual.residual > 3
    assert swapped.witness / usual.witness == pytest.approx(1, rel=0.01)
    assert fusion.witness < 0.3 * measure_fusion(scans).witness
    assert fusion.residual < 0.3 * swapped.residual


def test_a_rare_view_speaks_against_its_class() -> None:
    forest, agreed = np.full(3, 1 / 3), alike(20.0, 20.0, np.nan)
    agreed[1, 2] = 2.3
    shares = Fusion(1.0, 5.0).probabilities(forest, agreed, 10**9)
    assert shares[0] / shares[1] == pytest.approx(np.exp(Fusion().view * 2.0))
    assert shares[2] == pytest.approx(shares[1])  # as the worst that was compared
    scans = judged(count=3000)
    scans.agreed[:, :, 2] = np.random.default_rng(3).normal(0, 1, scans.agreed.shape[:2])
    assert measure_fusion(scans).view < 0.4 * Fusion().view  # it says nothing here


def test_probabilities_sum_to_one_and_scraps_say_less() -> None:
    fusion = Fusion(1.0, 5.0)
    forest, agreed = np.array([0.7, 0.2, 0.1]), alike(20.0, 40.0, np.nan)
    most = 0.0
    for points in (12, 30, 100, 1000, 100_000):
        shares = fusion.probabilities(forest, agreed, points)
        assert shares.sum() == pytest.approx(1)
        assert shares[0] > most
        most = shares[0]
    assert fusion.probabilities(forest, agreed, 12)[0] < 0.7


def test_a_class_that_was_not_compared_counts_as_the_worst_of_the_others() -> None:
    forest = np.full(3, 1 / 3)
    shares = Fusion(1.0, 5.0).probabilities(forest, alike(20.0, 40.0, np.nan), 1000)
    assert shares[2] == pytest.approx(shares[1])
    none = Fusion(1.0, 5.0).probabilities(np.array([0.7, 0.2, 0.1]), alike(*[np.nan] * 3), 10**9)
    np.testing.assert_allclose(none, [0.7, 0.2, 0.1], atol=1e-6)


def test_a_class_that_cannot_hold_the_scan_is_clearly_worse_than_the_worst_that_can() -> None:
    forest, fusion = np.full(3, 1 / 3), Fusion(1.0, 5.0)
    for misfit in (0.1, 20.0, 500.0):
        shares = fusion.probabilities(forest, alike(misfit, np.inf, np.nan), 1000)
        assert shares[0] == pytest.approx(shares[2])
        assert shares[0] > 50 * shares[1]


def test_a_scan_that_no_cad_can_hold_is_of_no_class_rather_than_of_another() -> None:
    """A whole frame, or parts that touch: what the forest says of it counts for nothing."""
    forest = np.array([0.95, 0.04, 0.01])
    shares = Fusion().probabilities(forest, alike(np.inf, np.inf, np.nan), 1000)
    np.testing.assert_allclose(shares, 1 / 3)


def test_a_share_of_known_scans_is_less_familiar() -> None:
    scans = judged()
    fusion = measure_fusion(scans)
    shares = answers(fusion, scans)
    best = shares.argmax(axis=1)
    familiar = [
        fusion.familiarity(float(scans.familiar[i]), NAMES[k], float(scans.agreed[i, k, 0]))
        for i, k in enumerate(best)
    ]
    for share in (0.05, 0.2, 0.5):
        assert np.mean(np.array(familiar) < share) == pytest.approx(share, abs=0.02)


def test_what_agrees_worse_is_less_familiar_and_no_pose_is_least() -> None:
    fusion = measure_fusion(judged())
    shares = [
        fusion.familiarity(0.5, "rod", misfit) for misfit in (20.0, 40.0, 80.0, 300.0, np.inf)
    ]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.3
    assert shares[-1] < 0.05


def test_hardly_a_rightly_named_scan_is_lost_and_what_agrees_worse_than_all_is() -> None:
    scans = judged()
    fusion = measure_fusion(scans)
    best = answers(fusion, scans).argmax(axis=1)
    posed = poses(fusion, scans)
    assert 0 < lost(fusion, [posed[i] for i in np.flatnonzero(best == scans.labels)]) <= 0.03
    assert fusion.lost("rod", 300.0)
    assert fusion.lost("rod", np.inf)
    harsh = replace(fusion, typical={"rod": 8.0})
    assert harsh.lost("rod", np.inf)  # parts that differ by more than the tolerance
    assert not harsh.lost("rod", 300.0)
    # Scans whose own pose is wrong do not open the limit, however many.
    wrong = scans.disagreement[np.arange(len(best)), scans.labels] > 40
    open_ = Judged(**{**vars(scans), "posed": ~wrong})
    assert 0.02 < wrong.mean() < 0.3
    assert measure_fusion(open_).worst < fusion.worst
    few = Judged(**{key: value[:9] if key != "class_names" else value
                    for key, value in vars(scans).items()})  # fmt: skip
    assert measure_fusion(few).lost("rod", 300.0) is None  # too few


def test_scans_that_show_less_than_simulated_ones_are_lost() -> None:
    fusion = measure_fusion(judged())
    right = [("rod", 1.0, share) for share in np.linspace(0.6, 1.0, 120)]
    shown = fusion.of_shown(right)
    assert fusion.of_shown([*right, *(("rod", 300.0, 0.1),) * 9]) == shown  # those are lost
    assert [shown.lost("rod", 1.0, share) for share in (0.6, 0.5, 0.1)] == [False, True, True]
    assert not fusion.lost("rod", 1.0, 0.1)
    assert fusion.of_shown([("rod", 1.0, 0.9)] * 9) == fusion  # too few


def poses(fusion: Fusion, scans: Judged, times: float = 1.0) -> list[tuple[str, float]]:
    """Answered class and disagreement of scans by a camera that is so many times noisier."""
    best = answers(fusion, scans).argmax(axis=1)
    return [(NAMES[k], times * float(scans.disagreement[i, k])) for i, k in enumerate(best)]


def lost(fusion: Fusion, found: list[tuple[str, float]]) -> float:
    """Return the share of poses that are lost."""
    flags = [fusion.lost(*one) for one in found]
    assert None not in flags
    return sum(map(bool, flags)) / len(flags)


@pytest.mark.parametrize("share", [0.0, 0.15])
@pytest.mark.parametrize("times", [0.1, 0.3, 1.0, 4.0])
def test_a_calm_camera_tightens_the_limit_and_nothing_widens_it(times: float, share: float) -> None:
    """A few of the scans may be foreign; they disagree eight times as much as known ones."""
    fusion, known = measure_fusion(judged(0)), judged(1)
    found, foreign = poses(fusion, known, times), poses(fusion, judged(2), 8 * times)
    mixed = found[: round(60 * (1 - share))] + foreign[: round(60 * share)]
    calm = fusion.of_scans(mixed)
    assert 0 <= calm.calm <= max(0.0, -np.log(times)) + 0.2
    assert (calm.calm == 0) == (times >= 1)
    assert lost(calm, found) <= lost(fusion, found) + 0.1
    assert lost(calm, foreign) > 0.95
    assert times > 0.2 or lost(fusion, foreign) < 0.5
    assert calm.of_scans(mixed) == calm  # whatever was measured before


@pytest.mark.parametrize("share", [0.2, 0.35, 0.5, 0.6])
@pytest.mark.parametrize("by_class", [False, True])
def test_scans_that_are_calmer_than_others_cost_these_nothing(share: float, by_class: bool) -> None:
    """Near scans, or matte parts: the others agree as simulated ones do, and are not lost."""
    fusion = measure_fusion(judged(0))
    found = poses(fusion, judged(1))
    part = len(found) * share
    calm = [name == "rod" if by_class else i < part for i, (name, _) in enumerate(found)]
    others = [one for one, is_calm in zip(found, calm, strict=True) if not is_calm]
    mixed = others + [(name, off / 10) for (name, off), one in zip(found, calm, strict=True) if one]
    assert lost(fusion.of_scans(mixed), others) <= lost(fusion, others) + 0.07


def test_few_scans_show_no_camera_and_chance_hardly_ever_does() -> None:
    fusion = measure_fusion(judged(0))
    calm = poses(fusion, judged(1), 0.1)
    assert fusion.of_scans(calm[:19]) == fusion
    assert fusion.of_scans(calm[:20]).calm > 1
    assert fusion.of_scans([("rod", np.inf)] * 40) == fusion
    assert fusion.of_scans(poses(fusion, judged(1), 1e-4)).calm == 4.0  # no camera counts more
    assert Fusion().of_scans(calm) == Fusion()  # nothing was simulated
    few = [fusion.of_scans(poses(fusion, judged(seed))[:20]) for seed in range(1, 41)]
    assert sum(one.calm > 0 for one in few) <= 2


@pytest.mark.parametrize(
    "damage",
    [
        {"forest": -1.0},
        {"witness": float("nan")},
        {"witness": 1e9},
        {"misfits": (1.0, 0.0), "joint": (0.0, 1.0)},
        {"misfits": (0.0, 1.0)},
        {"misfits": (0.0, float("nan")), "joint": (0.0, 1.0)},
        {"typical": {"rod": float("inf")}},
        {"residual": -1.0},
        {"worst": 0.0},
        {"worst": float("nan")},
        {"worst": float("inf")},
        {"calm": -0.1},
        {"calm": float("nan")},
        {"calm": 9.0},
    ],
)
def test_damaged_weights_are_refused(damage: dict) -> None:
    with pytest.raises(InputError):
        Fusion(**damage)
