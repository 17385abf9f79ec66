"""The catalogue of effects, and how a user's own effect file is found."""

from __future__ import annotations

import difflib
import importlib.util
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.body import chassis, suspension
from lunar_mjx.effects.heat import paths as thermal
from lunar_mjx.effects.heat import sources as heat_sources
from lunar_mjx.effects.joint import driveline, electrical, friction
from lunar_mjx.effects.joint import motor as motor_module
from lunar_mjx.effects.power import chassis as chassis_heat
from lunar_mjx.effects.power import supply
from lunar_mjx.effects.sensor import channel_errors as sensors
from lunar_mjx.effects.soil import ground as soil
from lunar_mjx.effects.soil import multipass, ruts, slip_sinkage
from lunar_mjx.effects.soil import variation as soil_variation
from lunar_mjx.effects.wheel import (
    bulldozing,
    contact_angles,
    friction_circle,
    granular,
    grousers,
    paper,
    rim_contact,
    rock,
    sliding_contact,
    stress_integral,
)
from lunar_mjx.effects.wheel import closed_form as wheel
from lunar_mjx.errors import UserError, require_file
from lunar_mjx.trust import vouch


def _by_name(effects: Iterable[Effect]) -> dict[str, Effect]:
    return {effect.name: effect for effect in effects}


CATALOGUE: Mapping[str, Effect] = _by_name(
    (
        motor_module.joint_control,
        motor_module.thermal_cutoff,
        motor_module.motor,
        soil.soil,
        soil.surface_type,
        soil.hard_surface,
        soil.soft_ground,
        soil.soil_gradient,
        wheel.pressure_sinkage,
        wheel.shear_state,
        wheel.closed_form_shear,
        stress_integral.stress_integral,
        granular.granular_resistance,
        rock.hard_ground,
        rock.boulders,
        rock.static_boulders,
        rock.chassis_contact,
        rock.joint_limits,
        paper.penalty_contact,
        paper.printed_shear,
        paper.engine_friction,
        rim_contact.rim_contact,
        chassis.payload,
        chassis.com_offset,
        chassis.wheel_radius_error,
        chassis.steering_toe,
        chassis.parking_brake,
        chassis.wheel_wear,
        chassis.gravity_error,
        chassis.tether,
        slip_sinkage.slip_sinkage,
        slip_sinkage.angle_sinkage,
        sliding_contact.slide_softening,
        sliding_contact.side_entry,
        sliding_contact.side_exit,
        sliding_contact.shear_softening,
        sliding_contact.skid_shear,
        sliding_contact.side_wall,
        soil_variation.gravity_soil,
        soil_variation.slope_stiffness,
        soil_variation.soil_patches,
        multipass.multipass,
        ruts.ruts,
        contact_angles.exit_angle,
        contact_angles.dynamic_sinkage,
        friction_circle.friction_circle,
        grousers.grousers,
        grousers.grouser_pulsation,
        bulldozing.bulldozing,
        bulldozing.rolling_resistance,
        suspension.suspension_friction,
        suspension.dust_charging,
        supply.motor_power,
        supply.electronics,
        supply.solar_panels,
        supply.battery,
        chassis_heat.chassis_node,
        thermal.winding_conduction,
        thermal.rotor_stator_path,
        thermal.housing_convection,
        thermal.housing_conduction,
        thermal.housing_radiation,
        heat_sources.iron_loss,
        heat_sources.gear_friction_heat,
        heat_sources.solar_flux,
        heat_sources.regolith_infrared,
        motor_module.magnet_nonlinearity,
        friction.directional_gear_efficiency,
        friction.coulomb_friction,
        friction.stribeck_friction,
        friction.viscous_friction,
        friction.cold_grease,
        friction.cogging,
        driveline.actuator_delay,
        driveline.driveline_compliance,
        driveline.backlash,
        electrical.voltage_saturation,
        electrical.bus_droop,
        sensors.clock_offset,
        sensors.clock_drift,
        sensors.channel_scale,
        sensors.encoder_quantisation,
        sensors.odometry_drift,
        sensors.imu_bias,
        sensors.thermistor_lag,
        sensors.harness_resistance,
        sensors.cross_talk,
    )
)
"""Every effect that ships, by name."""


def get(name: str) -> Effect:
    """The effect called `name` in the catalogue, or `file.py:name` in a user's own file.

    Raises:
      UserError: no such effect; the sentence names those that are spelt alike.
    """
    # A user's file is code that runs: `vouch` asks for consent where a file names it that the user did not write.
    if ".py" in name:
        vouch(name)
        file, _, member = name.partition(":")
        found = load_file(file)
        if not member:
            if len(found) != 1:
                raise UserError(
                    f"{file}: holds the effects {', '.join(found)}; say which one, as in {file}:{next(iter(found))}."
                )
            return next(iter(found.values()))
        if member not in found:
            raise UserError(f"{file}: no effect is called {member!r} there; it holds {', '.join(found)}.")
        return found[member]
    if name not in CATALOGUE:
        # The whole catalogue would fill half a screen.
        alike = difflib.get_close_matches(name, CATALOGUE, n=3, cutoff=0.5)
        meant = f"; did you mean {' or '.join(alike)}" if alike else ""
        raise UserError(
            f"effect {name!r} is not in the catalogue{meant}; use a name of `lunar-mjx effect list` or a file "
            f"(my_effects.py:{name})."
        )
    return CATALOGUE[name]


def load_file(path: str | Path) -> dict[str, Effect]:
    """Runs a user's Python file and returns the effects that it defines, by name.

    The file is the user's own code and is run as such.

    Raises:
      UserError: the file is missing, does not run, or defines no effect.
    """
    path = require_file(path, "the effect file")
    spec = importlib.util.spec_from_file_location(f"lunar_mjx_user_effects.{path.stem}", path)
    if spec is None or spec.loader is None:
        raise UserError(f"{path}: is not a Python file; give a file ending in .py.")
    module = importlib.util.module_from_spec(spec)
    # Pickling and dataclasses look their module up by name.
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except KeyboardInterrupt:
        raise
    # Whatever a user's file does wrong becomes one sentence: SystemExit too, because scripts end with it.
    except BaseException as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{path}: does not run: {type(error).__name__}: {reason}; mend the file.") from error
    found = _by_name(v for v in vars(module).values() if isinstance(v, Effect))
    if not found:
        raise UserError(f"{path}: defines no effect; decorate a function with lunar_mjx.effects.effect(port, ...).")
    return found
