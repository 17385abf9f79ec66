"""The table `[posterior]` of a `model.toml`: it comes back as it was written, and mistakes in it are named."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lunar_mjx.diagnosis.fitted_model import posterior_of
from lunar_mjx.errors import UserError
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.model import make_model
from lunar_mjx.model.file import load_model, save_model
from lunar_mjx.model.posterior import Posterior

NAMES = ("soil.k_phi", "soil.friction_angle", "motor.resistance")
COVARIANCE = np.array([[0.04, 0.006, 0.0], [0.006, 0.0025, 0.001], [0.0, 0.001, 0.01]])


@pytest.fixture(scope="module")
def model():
    posterior = Posterior.of(NAMES, (True, False, True), COVARIANCE)
    return dataclasses.replace(make_model("luvmi_x", "flat"), posterior=posterior)


def test_a_file_brings_back_the_covariance(model, tmp_path):
    found = load_model(save_model(model, tmp_path / "fitted.toml")).posterior
    assert (found.parameters, found.log) == (NAMES, (True, False, True))
    np.testing.assert_allclose(found.covariance, COVARIANCE, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(found.factor() @ found.factor().T, COVARIANCE, rtol=1e-9, atol=1e-15)


def test_what_leaves_the_model_leaves_its_posterior(model):
    assert model.add("slip_sinkage").posterior.parameters == NAMES
    kept = model.remove("soil").posterior
    assert kept.parameters == ("motor.resistance",) and kept.covariance == pytest.approx(0.01)
    assert dataclasses.replace(model, posterior=kept).remove("motor").posterior is None


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"soil.k_phi"', '"soil.colour"', "soil.colour"),
        ('"soil.k_phi"', '"motor.resistance"', "stands there twice"),
        ("    true,\n    false,", "    true,", "posterior.log"),
        ("    0.2,", "    -0.2,", "posterior.std of soil.k_phi"),
        ("        1.0,", "        1.6,", "is no matrix of correlations"),
        ("[posterior]", "[posterior]\nmean = 1.0", "posterior.mean"),
    ],
)
def test_mistakes_are_named(model, tmp_path, old, new, says):
    path = save_model(model, tmp_path / "fitted.toml")
    text = path.read_text()
    head, table, tail = text.partition("[posterior]")
    assert old in table + tail
    path.write_text(head + (table + tail).replace(old, new, 1))
    with pytest.raises(UserError, match=r"fitted\.toml") as error:
        load_model(path)
    assert says in str(error.value)


def test_a_logarithm_needs_a_positive_value(model, tmp_path):
    still = model.set("soil", cohesion=0.0)
    posterior = Posterior.of(("soil.cohesion",), (True,), np.eye(1))
    path = save_model(dataclasses.replace(still, posterior=posterior), tmp_path / "fitted.toml")
    with pytest.raises(UserError, match="has no logarithm"):
        load_model(path)


def test_a_fit_tells_of_the_models_own_parameters_alone(model):
    coordinates = (
        Coordinate("soil", "k_phi", 8e5, 0.3, 1e4, 1e9, log=True),
        Coordinate("initial", "yaw", 0.0, 0.1, -1.0, 1.0, log_index=0),
        Coordinate("soil", "cohesion", 170.0, 85.0, 0.0, 2e4),
        Coordinate("motor", "resistance", 1.0, 0.05, 0.1, 10.0, log=True, factor=True),
        Coordinate("slip_sinkage", "driving", 0.0, 0.3, 0.0, 2.0),
    )
    covariance = np.diag([0.01, 1.0, 0.25, 4.0, 1.0])
    covariance[0, 2] = covariance[2, 0] = 0.02
    # The resistance is as open as before; 7 is the column of a discrepancy.
    found = posterior_of(coordinates, np.pad(covariance, (0, 1)), np.full(6, 2.0), [0, 1, 2, 3, 4, 7], model)
    assert (found.parameters, found.log) == (("soil.k_phi", "soil.cohesion"), (True, False))
    np.testing.assert_allclose(found.covariance, [[0.09 * 0.01, 0.3 * 85 * 0.02], [0.3 * 85 * 0.02, 85**2 * 0.25]])
    assert posterior_of(coordinates, 4.0 * np.eye(1), np.full(1, 2.0), [3], model) is None
