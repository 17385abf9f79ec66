"""The linear-Gaussian evidence against dense Gaussians, numerical integration and drawn truths."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy import integrate, optimize, special, stats

from lunar_mjx.inference import evidence
from lunar_mjx.inference.evidence import (
    Amplitudes,
    EvidenceError,
    Field,
    Gram,
    Levels,
    NoiseSize,
    infer,
    infer_levels,
    log_box,
    log_density,
)

N, OWN, EACH = 60, 3, 8
FIELDS = (Field("a", 0.5), Field("b", 0.2, log_std=0.4))
NOISES = (NoiseSize("stated", 0.3), NoiseSize("replicates", freedom=20.0))


@pytest.fixture
def drawn():
    rng = np.random.default_rng(3)
    columns = rng.normal(size=(N, OWN + 2 * EACH))
    field = np.repeat([-1, 0, 1], [OWN, EACH, EACH])
    std = np.concatenate([[2.0, 5.0, 0.3], rng.uniform(0.5, 1.5, 2 * EACH)])
    mean = np.zeros(len(std))
    mean[:OWN] = 0.4, -1.0, 0.0
    group = rng.integers(0, 2, N)
    sizes = np.append([0.4, 0.1], 1.0)[field]
    truth = mean + std * sizes * rng.normal(size=len(std))
    residual = columns @ truth + np.array([1.1, 0.8])[group] * rng.normal(size=N)
    return columns, residual, group, Amplitudes.of(std, field, mean)


def dense(columns, residual, group, amplitudes, tau, noise):
    """Log density by the measurements' own covariance."""
    scale = amplitudes.std * np.append(tau, 1.0)[amplitudes.field]
    covariance = (columns * scale**2) @ columns.T + np.diag(np.asarray(noise)[group] ** 2)
    return stats.multivariate_normal.logpdf(residual, columns @ amplitudes.mean, covariance)


def priors(tau, noise):
    """Log prior density of the logarithms of the sizes."""
    half, told = FIELDS
    total = stats.halfnorm.logpdf(tau[0], scale=half.usual) + math.log(tau[0])
    total += stats.norm.logpdf(math.log(tau[1] / told.usual), scale=told.log_std)
    total += stats.norm.logpdf(math.log(noise[0]), scale=0.3)
    v = NOISES[1].freedom
    variance = noise[1] ** 2
    return total + stats.invgamma.logpdf(variance, v / 2, scale=v / 2) + math.log(2.0 * variance)


def test_density_at_given_sizes_is_that_of_the_dense_gaussian(drawn):
    columns, residual, group, amplitudes = drawn
    gram = Gram.of(columns, residual, group, 2)
    for tau, noise in (([0.4, 0.1], [1.0, 0.9]), ([3.0, 1e-3], [0.5, 2.0])):
        tau, noise = np.array(tau), np.array(noise)
        x = np.log(np.concatenate([tau, noise]))
        found = evidence._density(x, gram, amplitudes, FIELDS, NOISES)
        wanted = dense(columns, residual, group, amplitudes, tau, noise) + priors(tau, noise)
        assert found.value == pytest.approx(wanted, abs=1e-8)


@pytest.mark.parametrize("bounded", [False, True])
def test_gradient_and_hessian_are_derivatives(drawn, bounded):
    columns, residual, group, amplitudes = drawn
    gram = Gram.of(columns, residual, group, 2)
    x = np.log([0.6, 0.15, 1.2, 0.9])
    fields = (Field("beyond the wall by a twentieth", 0.57, bounded=True), FIELDS[1]) if bounded else FIELDS

    def at(y):
        return evidence._density(y, gram, amplitudes, fields, NOISES)

    step = 1e-5 * np.eye(4)
    slope = np.array([(at(x + h).value - at(x - h).value) / 2e-5 for h in step])
    bend = np.array([(at(x - h).gradient - at(x + h).gradient) / 2e-5 for h in step])
    np.testing.assert_allclose(at(x).gradient, slope, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(at(x).hessian, bend, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("start", [0.01, 0.1, 100.0])
def test_a_bounded_size_ends_at_its_wall_wherever_it_begins(drawn, start):
    columns, residual, group, amplitudes = drawn
    gram = Gram.of(columns, residual, group, 2)
    free = infer(gram, amplitudes, FIELDS, NOISES)
    fields = (Field("far below what the measurements ask for", 0.1 * free.tau[0], bounded=True), FIELDS[1])
    found = infer(gram, amplitudes, fields, NOISES, (np.array([start, 0.1]), np.ones(2)))
    assert 0.9 < found.tau[0] / fields[0].usual < 1.2


def test_posterior_is_that_of_the_dense_gaussian(drawn):
    columns, residual, group, amplitudes = drawn
    found = infer(Gram.of(columns, residual, group, 2), amplitudes, FIELDS, NOISES)
    scale = amplitudes.std * np.append(found.tau, 1.0)[amplitudes.field]
    noise = np.diag(found.noise[group] ** 2)
    inverse = np.linalg.inv((columns * scale**2) @ columns.T + noise)
    gain = (scale**2)[:, None] * columns.T @ inverse
    mean = amplitudes.mean + gain @ (residual - columns @ amplitudes.mean)
    np.testing.assert_allclose(found.mean, mean, atol=1e-9)
    np.testing.assert_allclose(found.covariance, np.diag(scale**2) - gain @ columns * scale**2, atol=1e-9)


def test_accumulated_parts_and_chosen_columns_are_the_whole(drawn):
    columns, residual, group, amplitudes = drawn
    whole = Gram.of(columns, residual, group, 2)
    parts = Gram.of(columns[:20], residual[:20], group[:20], 2) + Gram.of(columns[20:], residual[20:], group[20:], 2)
    np.testing.assert_allclose(parts.matrix, whole.matrix, atol=1e-12)
    keep = np.array([0, 2, 5, 12])
    few = infer(whole.select(keep), amplitudes.select(keep), FIELDS, NOISES)
    same = infer(Gram.of(columns[:, keep], residual, group, 2), amplitudes.select(keep), FIELDS, NOISES)
    assert few.log_evidence == pytest.approx(same.log_evidence, abs=1e-9)


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2, 3))])
def test_laplace_over_sizes_agrees_with_quadrature(seed):
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(40, 12)) * 2.0
    residual = columns @ (0.3 * (seed % 2) * rng.normal(size=12)) + rng.normal(size=40)
    amplitudes = Amplitudes.of(np.ones(12), np.zeros(12, int))
    gram = Gram.of(columns, residual)
    field, noise = (Field("a", 0.2),), (NoiseSize("n", 0.3),)
    found = infer(gram, amplitudes, field, noise)

    def density(log_s, log_tau):
        x = np.array([log_tau, log_s])
        return math.exp(evidence._density(x, gram, amplitudes, field, noise).value - found.log_evidence)

    # tau below 1e-4 changes nothing: its prior mass there is negligible
    ratio = integrate.dblquad(density, math.log(1e-4), math.log(2.0), -1.5, 1.5, epsabs=1e-3)[0]
    # a size that the data do not show has a long tail towards none, which Laplace's normal lacks: a fifth of a nat
    assert -0.05 < math.log(ratio) < 0.25


def test_predictive_score_is_the_conditional_density(drawn):
    columns, residual, group, amplitudes = drawn
    fit, held = np.arange(N) < 40, np.arange(N) >= 40
    found = infer(Gram.of(columns[fit], residual[fit], group[fit], 2), amplitudes, FIELDS, NOISES)
    score = found.log_score(Gram.of(columns[held], residual[held], group[held], 2))
    mean = columns[held] @ found.mean
    covariance = columns[held] @ found.covariance @ columns[held].T + np.diag(found.noise[group[held]] ** 2)
    assert score == pytest.approx(stats.multivariate_normal.logpdf(residual[held], mean, covariance), abs=1e-7)


def test_truncated_prior_of_one_amplitude_is_exact():
    rng = np.random.default_rng(0)
    column = rng.normal(size=(30, 1))
    residual = 0.2 * column[:, 0] + rng.normal(size=30)
    noises = (NoiseSize("n", 1e-4),)
    found = infer(Gram.of(column, residual), Amplitudes.of(np.array([0.7])), (), noises)

    def density(a):
        return math.exp(
            float(np.sum(stats.norm.logpdf(residual, column[:, 0] * a)))
            + stats.norm.logpdf(a, 0.0, 0.7)
            - found.log_evidence
        ) / (stats.norm.cdf(1.0, 0.0, 0.7) - 0.5)

    wanted = math.log(integrate.quad(density, 0.0, 1.0)[0])
    assert found.log_inside(np.array([0.0]), np.array([1.0])) == pytest.approx(wanted, abs=1e-3)


def test_sizes_are_found_again():
    rng = np.random.default_rng(1)
    columns = rng.normal(size=(3000, 200)) * 5.0
    residual = columns @ (0.07 * rng.normal(size=200)) + 1.3 * rng.normal(size=3000)
    found = infer(
        Gram.of(columns, residual),
        Amplitudes.of(np.ones(200), np.zeros(200, int)),
        (Field("a", 0.05),),
        (NoiseSize("n", 0.3),),
    )
    assert found.tau[0] == pytest.approx(0.07, rel=0.15)
    assert found.noise[0] == pytest.approx(1.3, rel=0.05)


def test_sizes_that_creep_count_as_soon_as_little_is_left(drawn, monkeypatch):
    columns, residual, group, amplitudes = drawn
    gram = Gram.of(columns, residual, group, 2)
    settled = infer(gram, amplitudes, FIELDS, NOISES)

    def after(steps: int) -> evidence.Evidence:
        fewer = dataclasses.replace(evidence.SIZE_DESCENT, most_steps=steps)
        monkeypatch.setattr(evidence, "SIZE_DESCENT", fewer)
        return infer(gram, amplitudes, FIELDS, NOISES)

    with pytest.raises(EvidenceError, match="still promises"):
        after(1)
    answers = {}
    for steps in range(2, 10):
        try:
            answers[steps] = after(steps)
        except EvidenceError:
            continue
    first = answers[min(answers)]
    # it was taken before the sizes had settled, and is what it would have become
    assert first.settled > evidence.SIZE_DESCENT.settled
    assert first.log_evidence == pytest.approx(settled.log_evidence, abs=0.02)


def test_one_right_parameter_beats_a_field_of_many():
    rng = np.random.default_rng(2)
    shape = np.linspace(-1.0, 1.0, 80)
    modes = np.stack([shape**i for i in range(8)], axis=1)
    columns = np.column_stack([shape**2 - 0.3, modes]) * 10.0
    residual = 3.0 * (shape**2 - 0.3) + rng.normal(size=80)
    gram = Gram.of(columns, residual)
    amplitudes = Amplitudes.of(np.ones(9), np.append(-1, np.zeros(8, int)))
    field, noise = (Field("a", 0.05),), (NoiseSize("n", 0.3),)
    both = infer(gram, amplitudes, field, noise).log_evidence
    rest = np.arange(1, 9)
    alone = infer(gram.select(rest), amplitudes.select(rest), field, noise).log_evidence
    wide = infer(gram.select(rest), amplitudes.select(rest), (Field("a", 0.5),), noise).log_evidence
    assert both > alone + 3.0
    assert both > wide + 3.0


def test_values_that_are_not_finite_are_refused():
    with pytest.raises(EvidenceError, match="not finite"):
        Gram.of(np.array([[np.nan]]), np.zeros(1))


def _by_conditioning(mean: np.ndarray, covariance: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Log probability of a box in two dimensions, by quadrature over the first coordinate."""
    std = math.sqrt(covariance[0, 0])
    share = covariance[0, 1] / covariance[0, 0]
    rest = math.sqrt(covariance[1, 1] - share * covariance[0, 1])
    x = np.linspace(max(low[0], mean[0] - 12.0 * std), min(high[0], mean[0] + 12.0 * std), 200_001)
    inner = mean[1] + share * (x - mean[0])
    logs = stats.norm.logpdf(x, mean[0], std)
    logs = logs + np.log(stats.norm.sf((low[1] - inner) / rest) - stats.norm.sf((high[1] - inner) / rest))
    return float(special.logsumexp(logs) + math.log(x[1] - x[0]))


@pytest.mark.parametrize("correlation", (-0.9, 0.0, 0.6, 0.95))
@pytest.mark.parametrize("far", (0.5, 3.0))
def test_bounds_that_bind_together_are_taken_together(correlation: float, far: float):
    mean = np.array([-far, 0.3 - far])
    covariance = np.array([[1.0, 1.4 * correlation], [1.4 * correlation, 1.96]])
    low, high = np.zeros(2), np.array([5.0, 6.0])
    wanted = _by_conditioning(mean, covariance, low, high)
    assert log_box(mean, covariance, low, high) == pytest.approx(wanted, abs=0.02 + 0.02 * abs(wanted))


def test_a_box_of_independent_coordinates_is_the_product_of_its_sides():
    mean, std = np.array([0.4, -2.0, 1.0]), np.array([1.0, 0.5, 3.0])
    low, high = np.array([0.0, 0.0, -np.inf]), np.array([1.0, np.inf, 2.0])
    sides = stats.norm.cdf((high - mean) / std) - stats.norm.cdf((low - mean) / std)
    assert log_box(mean, np.diag(std**2), low, high) == pytest.approx(float(np.log(sides).sum()), abs=1e-6)


def test_many_bounds_agree_with_samples():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(5, 5))
    covariance = root @ root.T + 0.1 * np.eye(5)
    mean = rng.normal(size=5)
    low, high = np.zeros(5), np.full(5, np.inf)
    drawn = rng.multivariate_normal(mean, covariance, 1_000_000)
    wanted = math.log(np.mean(np.all(drawn > low, axis=1)))
    assert log_box(mean, covariance, low, high) == pytest.approx(wanted, abs=0.15)


def test_derivatives_that_rounding_spoils_are_no_proof():
    """More is explained than there is: no measurements have such sums, and the gain would be of any size."""
    gram = Gram(np.array([50]), np.array([[[1e30, 3e15], [3e15, 1.0]]]))
    with pytest.raises(EvidenceError, match="too steep"):
        infer(gram, Amplitudes.of(np.ones(1)), (), [NoiseSize("x")])


def test_sizes_at_which_rounding_spoils_the_density_are_gone_around(monkeypatch):
    """The first step overshoots to a fifth of the noise. On a foreign Husky such a one ended `compare`."""
    rng = np.random.default_rng(3)
    gram = Gram.of(rng.normal(size=(200, 1)), 0.5 * rng.normal(size=200))
    wanted = infer(gram, Amplitudes.of(np.ones(1)), (), [NoiseSize("x", 3.0)])
    condition, refused = evidence._condition, []

    def steep(gram, amplitudes, tau, noise):
        if noise[0] < 0.4:
            refused.append(noise[0])
            raise EvidenceError("too steep")
        return condition(gram, amplitudes, tau, noise)

    monkeypatch.setattr(evidence, "_condition", steep)
    found = infer(gram, Amplitudes.of(np.ones(1)), (), [NoiseSize("x", 3.0)])
    assert refused and found.noise == pytest.approx(wanted.noise, rel=1e-4)
    assert found.log_evidence == pytest.approx(wanted.log_evidence, abs=1e-6)


def test_the_most_probable_level_of_slow_errors_is_taken(drawn):
    """Each level in turn tells what the search over levels has to find."""
    columns, residual, group, amplitudes = drawn
    rng = np.random.default_rng(8)
    extra = rng.normal(size=N)
    stretches = [np.ones(N), np.sqrt(1.0 + 4.0 * extra**2), np.full(N, 3.0)]

    def whiten(levels, values):
        return values / np.choose(levels[group], stretches)[:, None]

    scale = np.array([np.bincount(group, np.log(s), minlength=2) for s in stretches])
    log_prior = np.array([0.0, -1.0, -2.0])
    alone = {}
    for first in range(3):
        for second in range(3):
            at = np.array([first, second])
            levels = Levels(columns, residual, group, whiten, scale, log_prior, at[None])
            alone[first, second] = infer(levels.gram(at), amplitudes, FIELDS, NOISES).log_evidence + levels.log_weight(
                at
            )
    from_afar = Levels(columns, residual, group, whiten, scale, log_prior, np.array([[2, 2]]))
    found = infer_levels(from_afar, amplitudes, FIELDS, NOISES)
    assert tuple(found.levels) == max(alone, key=lambda k: alone[k])
    assert found.log_evidence == pytest.approx(max(alone.values()), abs=1e-4)


def test_draws_tell_what_amplitudes_may_still_change(drawn):
    columns, residual, group, amplitudes = drawn
    found = infer(Gram.of(columns, residual, group, 2), amplitudes, FIELDS, NOISES)
    told = evidence.expected_square(found.left(columns, residual)).sum()
    exact = np.sum((residual - columns @ found.mean) ** 2) + np.trace(columns @ found.covariance @ columns.T)
    spread = exact - np.sum((residual - columns @ found.mean) ** 2)
    assert told == pytest.approx(exact, abs=0.1 * spread)


def test_amplitudes_within_bounds_are_those_of_bounded_least_squares(drawn):
    """Amplitudes that no bound holds move to where they fit best beside those that one does."""
    columns, residual, group, amplitudes = drawn
    found = infer(Gram.of(columns, residual, group, 2), amplitudes, FIELDS, NOISES)
    low, high = np.full(len(found.mean), -np.inf), np.full(len(found.mean), np.inf)
    high[:2], low[2] = found.mean[:2] - [0.3, 0.5], found.mean[2] + 0.1
    root = np.linalg.cholesky(np.linalg.inv(found.covariance)).T
    best = optimize.lsq_linear(root, root @ found.mean, (low, high), tol=1e-12).x
    np.testing.assert_allclose(found.within(low, high), best, atol=1e-6)
    np.testing.assert_array_equal(found.within(low - 9.0, high + 9.0), found.mean)


def test_the_density_at_given_sizes_is_that_of_a_normal_distribution():
    rng = np.random.default_rng(5)
    columns, residual, group = rng.standard_normal((30, 4)), rng.standard_normal(30), np.arange(30) % 2
    amplitudes = Amplitudes.of([0.5, 2.0, 1.0, 3.0], field=[-1, 0, 0, -1], mean=[0.3, 0.0, 0.0, -0.2])
    tau, noise = np.array([0.7]), np.array([1.3, 0.8])
    std = amplitudes.std * np.append(tau, 1.0)[amplitudes.field]
    covariance = (columns * std**2) @ columns.T + np.diag(noise[group] ** 2)
    wanted = stats.multivariate_normal(columns @ amplitudes.mean, covariance).logpdf(residual)
    assert log_density(Gram.of(columns, residual, group, 2), amplitudes, tau, noise) == pytest.approx(wanted, abs=1e-9)


def test_steep_slopes_and_a_far_prior_mean_cost_no_digits():
    """Slopes of 1e5 sigma whose prior lies ten deviations from the refit: exact by least squares on all rows."""
    rng = np.random.default_rng(5)
    n = 400
    steep = rng.normal(size=(n, 3)) * 1e4
    plain = rng.normal(size=(n, 4))
    columns = np.column_stack([steep, steep @ [0.5, -0.3, 0.2] + 1e-2 * rng.normal(size=n), plain])
    residual = rng.normal(size=n)
    far = np.array([10.0, -8.0, 9.0, 5.0, 0.0, 0.0, 0.0, 0.0])
    prior = Amplitudes.of(np.ones(8), mean=far)
    # Exact: the posterior by least squares on all rows, priors among them, and the determinant by singular values.
    whole = np.vstack([columns, np.eye(8)])
    wanted = np.concatenate([residual, far])
    best = np.linalg.lstsq(whole, wanted, rcond=None)[0]
    chi_square = float(np.sum((wanted - whole @ best) ** 2))
    log_det = 2.0 * float(np.sum(np.log(np.linalg.svd(whole, compute_uv=False))))
    exact = -0.5 * (n * math.log(2.0 * math.pi) + chi_square + log_det)
    found = log_density(Gram.of(columns, residual), prior, np.zeros(0), np.ones(1))
    assert found == pytest.approx(exact, abs=1e-3)


def test_an_amplitude_of_student_t_size_has_cauchys_prior():
    """Amplitudes of a field of freedom 1 have Cauchy's density: with one exact column the evidence is its value."""
    field = Field("effect", 1.0, freedom=1.0)
    column, sigma = np.full((40, 1), 5.0), 1.0 / (5.0 * math.sqrt(40.0))
    for amount in (0.5, 9.0, 60.0):
        gram = Gram.of(column, column[:, 0] * amount)
        found = infer(gram, Amplitudes.of([1.0], [0]), (field,), (NoiseSize("y", 1e-3),))
        # The likelihood is a normal density of the amplitude, as narrow as sigma.
        exact = stats.cauchy.logpdf(amount) + math.log(sigma) + 0.5 * math.log(2.0 * math.pi)
        exact -= 20.0 * math.log(2.0 * math.pi)
        assert found.log_evidence == pytest.approx(exact, abs=0.35)
    gaussian = infer(gram, Amplitudes.of([1.0]), (), (NoiseSize("y", 1e-3),))
    assert gaussian.log_evidence < found.log_evidence - 1000.0
