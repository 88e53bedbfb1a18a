"""Statistics: known answers, and scipy as an oracle."""

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from bidex_meta.evaluation import statistics
from bidex_meta.evaluation.statistics import (
    RESAMPLES,
    Estimate,
    aggregate,
    bootstrap,
    bootstrap_band,
    crossed_estimate,
    estimate,
    iqm,
    iqm_difference,
    iqm_over_seeds,
    mean,
    mean_difference,
    paired_difference,
    percentile_interval,
    probability_of_improvement,
    resampled_means,
    share_above,
)

SAMPLES = st.lists(st.integers(-100, 100), min_size=1, max_size=40)


def normal(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def width(found: Estimate) -> float:
    assert found.interval is not None
    return found.interval[1] - found.interval[0]


@pytest.mark.parametrize("size", [2, 7, 60])
def test_the_interval_of_one_sample_is_scipys(size: int) -> None:
    sample = normal(size)
    oracle = scipy.stats.bootstrap(
        (sample,), np.mean, n_resamples=RESAMPLES, batch=200, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    found = estimate(mean, sample)
    assert found.value == pytest.approx(sample.mean())
    assert found.interval == pytest.approx((oracle.low, oracle.high), rel=1e-12)


def test_the_interval_of_a_difference_is_scipys() -> None:
    a, b = normal(30), normal(12, seed=1)
    oracle = scipy.stats.bootstrap(
        (a, b), lambda a, b, axis: a.mean(axis) - b.mean(axis),
        n_resamples=RESAMPLES, batch=200, method="percentile", rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    found = estimate(mean_difference, a, b)
    assert found.value == pytest.approx(a.mean() - b.mean())
    assert found.interval == pytest.approx((oracle.low, oracle.high), rel=1e-12)
    assert estimate(mean_difference, a, b[:1]).interval is None


def test_the_interval_of_many_values_is_that_of_the_normal_distribution() -> None:
    found = estimate(mean, normal(400))
    assert width(found) == pytest.approx(2 * 1.96 * normal(400).std() / 20, rel=0.06)


@given(SAMPLES)
def test_iqm_is_the_trimmed_mean(values: list[int]) -> None:
    sample = np.array(values, float)
    assert iqm(sample) == pytest.approx(scipy.stats.trim_mean(sample, 0.25))
    both = np.stack([sample, sample[::-1] + 1.0])
    assert iqm(both) == pytest.approx([iqm(sample), iqm(sample) + 1.0])


def test_iqm_leaves_out_the_outer_quarters() -> None:
    values = np.array([[0.0, 0.4], [0.6, 100.0]])
    found = iqm_over_seeds(values)
    assert found.value == pytest.approx(0.5)
    assert found.interval is not None and found.interval[0] <= 0.5 <= found.interval[1]
    assert iqm_over_seeds(values[:1]).interval is None


def test_a_difference_that_seeds_blur_holds_zero_and_a_clear_one_does_not() -> None:
    low = np.array([[0.1, 0.2], [0.12, 0.22], [0.1, 0.21]])
    high = np.array([[0.5, 0.6], [0.52, 0.6], [0.5, 0.63]])
    clear = iqm_difference(high, low)
    assert clear.excludes_zero and clear.interval is not None and clear.interval[0] > 0.3
    blurred = iqm_difference(np.array([[0.0], [0.5], [1.0]]), np.array([[0.1], [0.4], [0.9]]))
    assert blurred.interval is not None and not blurred.excludes_zero
    assert iqm_difference(high[:1], low).interval is None


@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=60))
def test_interval_ends_are_quantiles(values: list[float]) -> None:
    low, high = percentile_interval(np.array(values))
    assert (low, high) == pytest.approx(tuple(np.percentile(values, (2.5, 97.5))), abs=1e-9)


def test_a_level_is_drawn_within_each_unit_above_it() -> None:
    shapes = []

    def statistic(run: np.ndarray, task: np.ndarray, episode: np.ndarray) -> np.ndarray:
        shapes.append((run.shape, task.shape, episode.shape))
        assert run.max() < 2 and task.max() < 3 and episode.max() == 3
        return episode.mean(axis=(1, 2, 3))

    found = bootstrap(statistic, [(2,), (2, 3), (2, 3, 4)])
    assert shapes == [((200, 2), (200, 2, 3), (200, 2, 3, 4))] * 10
    assert found.shape == (RESAMPLES,) and found.mean() == pytest.approx(1.5, abs=0.05)
    again = bootstrap(lambda index: index[:, 0], [(50,)], np.random.default_rng(3))
    assert not np.array_equal(again, bootstrap(lambda index: index[:, 0], [(50,)])), "its own generator"


def test_nested_resampling_knows_the_variance_of_every_level() -> None:
    """Variances of a mean add up: over runs, over groups of all runs, over episodes of all groups."""
    runs, groups, episodes = 20, 10, 10
    for deviations in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
        of_run = deviations[0] * normal(runs, 1, 1)
        of_group = deviations[1] * normal(runs, groups, 1)
        values = of_run + of_group + deviations[2] * normal(runs, groups, episodes)
        resampled = resampled_means(values)
        assert resampled is not None
        # Resampled means also vary by the resampling of each outer level, which carries the noise of its inner means.
        between = values.mean(axis=(1, 2)).var() / runs
        within = values.mean(axis=2).var(axis=1).mean() / (runs * groups)
        inner = values.var(axis=2).mean() / (runs * groups * episodes)
        assert resampled.var() == pytest.approx(between + within + inner, rel=0.12)


def test_paired_differences_of_runs_that_differ_have_a_wider_interval() -> None:
    alike = np.stack([1 + normal(20, 10, seed=seed) for seed in range(4)])
    apart = alike + np.array([-3.0, -1.0, 1.0, 3.0])[:, None, None]
    narrow = paired_difference(alike)
    wide = paired_difference(apart)
    assert narrow.value == pytest.approx(wide.value) and narrow.interval and wide.interval
    assert narrow.interval[0] > 0.7 and narrow.interval[1] < 1.3
    # The standard deviation of the four shifts is sqrt(5), hence the standard error of their mean is about 1.1.
    assert wide.interval[0] < -0.5 and wide.interval[1] > 2.5
    assert paired_difference(np.ones((1, 1, 1))) == Estimate(1.0, None)


def test_a_band_is_the_interval_of_each_point() -> None:
    values = normal(8, 4, seed=3)
    low, high = bootstrap_band(values)
    for point in range(4):
        assert (low[point], high[point]) == pytest.approx(estimate(mean, values[:, point]).interval, abs=1e-12)


def test_crossed_intervals_are_of_tasks_and_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "RESAMPLES", 400)

    def success(tables: list[np.ndarray]) -> float:
        return float(tables[0].mean())

    half = crossed_estimate(success, [np.arange(100.0)[None] % 2])
    assert half.value == 0.5 and 0.15 < width(half) < 0.24, "a share of 0.5 of 100: 1.96 * 2 * 0.05"
    apart = crossed_estimate(success, [np.array([[0.0] * 100, [1.0] * 100])])
    assert apart.interval == (0.0, 1.0)
    assert crossed_estimate(success, [np.ones((1, 1)), np.zeros((1, 1))]).interval is None


def test_seeds_of_all_classes_are_resampled_together() -> None:
    opposite = [np.array([[0.0], [1.0]]), np.array([[1.0], [0.0]])]
    assert crossed_estimate(lambda tables: float(np.mean(tables)), opposite).interval == (0.5, 0.5)


@given(SAMPLES, SAMPLES)
def test_probability_of_improvement_is_mann_whitneys(a: list[int], b: list[int]) -> None:
    first, second = np.array(a)[:, None], np.array(b)[:, None]
    expected = scipy.stats.mannwhitneyu(a, b, method="asymptotic").statistic / (len(a) * len(b))
    assert probability_of_improvement(first, second) == pytest.approx(expected)
    assert probability_of_improvement(second, first) == pytest.approx(1.0 - expected)


def test_probability_of_improvement_compares_within_classes() -> None:
    assert probability_of_improvement(np.array([[0.1, 0.9]]), np.array([[0.2, 0.3]])) == 0.5


def test_share_above_leaves_out_ties() -> None:
    assert share_above(np.array([[0.0, 0.5], [0.6, 1.0]]), 0.5) == 0.5


def test_an_aggregate_is_of_the_classes_means_and_of_all_classes() -> None:
    samples = [np.array([0.0, 1.0]), np.full(9, 0.25), np.full(3, 1.0), np.full(3, 0.0)]
    found = aggregate(samples)
    assert found is not None and found.mean == 0.4375 and found.iqm == 0.375
    assert found.interval == (0.3125, 0.5625), "only the first class varies: 0, 1/2 or 1"
    assert aggregate([*samples, None]) is None and aggregate([]) is None


def test_estimates_are_written_with_their_interval() -> None:
    assert Estimate(0.5, (0.25, 0.75)).text(100.0, " %") == "50.0 % [25.0, 75.0]"
    assert Estimate(0.5, None).text() == "0.5" and not Estimate(0.5, None).excludes_zero
    assert Estimate(-1.0, (-2.0, -0.5)).excludes_zero
