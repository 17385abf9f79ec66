"""The current of the bus against a balance of power that is reckoned here."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

from lunar_mjx.dynamics.bus import BUS_CURRENT, tells_bus_voltage
from lunar_mjx.dynamics.signals import observe
from lunar_mjx.dynamics.state import Supply, Telemetry
from lunar_mjx.effects import catalogue
from lunar_mjx.effects.base import Effect
from lunar_mjx.rover import load_rover
from tests.dynamics.test_signals import system_of, telemetry

TIMES = np.array([0.0, 0.1])
VOLTAGE, CURRENT = np.zeros((2, 12)), np.zeros((2, 12))
VOLTAGE[:, :3] = [[12.0, 6.0, -20.0], [12.0, 6.0, 20.0]]
CURRENT[:, :3] = [[2.0, -1.0, -0.5], [2.0, -1.0, -0.5]]
POWER = np.array([24.0 - 6.0 + 10.0, 24.0 - 6.0 - 10.0])
"""W: of one that drives, one that brakes, and one that drives back and then brakes, too."""


def channels(*effects: Effect, voltage: object = None, **known: object) -> dict[str, np.ndarray]:
    seen = telemetry(TIMES, current=CURRENT, voltage=VOLTAGE, **known)
    system = system_of(load_rover("luvmi_x"), *effects)
    with jax.enable_x64(True):
        found = observe(system, seen, bus_voltage=voltage).channels
    return {k: np.asarray(v) for k, v in found.items()}


def test_the_bus_gives_the_motors_power_over_its_voltage() -> None:
    found = channels(voltage=24.0)["bus_current_A"]
    assert found == pytest.approx(POWER / 24.0, rel=1e-12)
    assert found[0] < np.abs(CURRENT[0]).sum(), "an amplifier lowers the voltage, and raises the current by as much"
    sagging = np.array([24.0, 12.0])
    assert channels(voltage=sagging)["bus_current_A"] == pytest.approx(POWER / sagging, rel=1e-12)
    assert "bus_current_A" not in channels(), "nobody knows the voltage"


def test_a_harness_takes_its_share() -> None:
    harness = catalogue.get("harness_resistance")
    lost = harness.nominal()["resistance"] * (CURRENT**2).sum(axis=1)
    assert channels(harness, voltage=24.0)["bus_current_A"] == pytest.approx((POWER + lost) / 24.0, rel=1e-6)


def test_a_model_with_a_supply_needs_no_voltage_from_elsewhere() -> None:
    droop = catalogue.get("bus_droop")
    p = droop.nominal()
    sagged = p["voltage"] - p["resistance"] * POWER / p["voltage"]
    assert channels(droop)["bus_current_A"] == pytest.approx(POWER / sagged, rel=1e-6)
    assert channels(droop, voltage=24.0)["bus_current_A"] == pytest.approx(POWER / 24.0, rel=1e-6)
    supply = Supply(load=np.array([90.0, 60.0]), solar=np.array([0.0, 80.0]), voltage=np.array([30.0, 20.0]))
    motors = catalogue.get("motor_power")
    assert channels(motors, supply=supply)["bus_current_A"] == pytest.approx([3.0, -1.0], rel=1e-12)
    of_others = np.array([90.0, -20.0])
    expected = (POWER + of_others) / [30.0, 20.0]
    assert channels(supply=supply)["bus_current_A"] == pytest.approx(expected, rel=1e-12), "electronics alone"
    assert tells_bus_voltage(("motor", "battery")) and not tells_bus_voltage(("motor", "electronics"))


def test_rovers_of_a_batch_have_a_bus_and_a_harness_of_their_own() -> None:
    """As many rovers as times: a resistance of each rover is none of each time."""
    droop, harness = catalogue.get("bus_droop"), catalogue.get("harness_resistance")
    system = system_of(load_rover("luvmi_x"), droop, harness)
    own = [
        {"bus_droop": {"resistance": r, "voltage": v}, "harness_resistance": {"resistance": np.linspace(r, 2 * r, 12)}}
        for r, v in ((0.1, 48.0), (0.4, 24.0))
    ]
    drives = [telemetry(TIMES, current=CURRENT * k, voltage=VOLTAGE) for k in (1.0, 0.5)]

    def drawn(seen: Telemetry, effects: dict) -> np.ndarray:
        params = dataclasses.replace(system.params, effects=effects)
        return np.asarray(observe(system, seen, params).channels[BUS_CURRENT])

    def stacked(trees: list) -> Any:
        return jax.tree.map(lambda *each: np.stack(each), *trees)

    with jax.enable_x64(True):
        alone = [drawn(seen, effects) for seen, effects in zip(drives, own, strict=True)]
        np.testing.assert_allclose(drawn(stacked(drives), stacked(own)), alone, rtol=1e-12)
        shared = own[0]["harness_resistance"]
        alone = [drawn(seen, {**p, "harness_resistance": shared}) for seen, p in zip(drives, own, strict=True)]
        found = drawn(stacked(drives), {**stacked(own), "harness_resistance": shared})
        np.testing.assert_allclose(found, alone, rtol=1e-12)
