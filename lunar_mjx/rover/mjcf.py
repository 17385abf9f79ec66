"""Builds the MJCF through `mujoco.MjSpec` and writes it with full precision."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import mujoco
import numpy as np

from lunar_mjx.rover.couplings import Coupling
from lunar_mjx.rover.description import GROUPS, Description
from lunar_mjx.rover.loops import PlacedLoop
from lunar_mjx.rover.roles import Roles
from lunar_mjx.rover.rover import DriveGroup
from lunar_mjx.rover.tree import Body

_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
}


def build_spec(
    name: str,
    roles: Roles,
    loops: tuple[PlacedLoop, ...],
    description: Description,
    standing_height: float,
    driven: tuple[DriveGroup, ...] = (),
    couplings: tuple[Coupling, ...] = (),
) -> mujoco.MjSpec:
    """Builds the model: free base, hinges, motors in the order drive, steer, suspension, and loop closures.

    Contacts and joint limits are off, so that equalities are the only constraints; the problem is then quadratic and
    one Newton iteration with one line-search step is exact. Limits stay readable as each joint's `range`.
    """
    spec = mujoco.MjSpec()
    spec.modelname = name
    # Radians throughout: no number of the file is in another unit than the code's.
    spec.compiler.degree = False
    spec.compiler.autolimits = False
    option = spec.option
    option.timestep = description.timestep
    option.gravity = [0.0, 0.0, -description.gravity]
    # Semi-implicit Euler, as the library's own engines step: parity compares like with like.
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    # Equalities alone make a quadratic problem, which one Newton step solves.
    option.iterations, option.ls_iterations = 1, 1
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    parents: dict[str | None, mujoco.MjsBody] = {None: spec.worldbody}
    for body in roles.bodies:
        parents[body.name] = _add_body(parents[body.parent], body, description, roles, standing_height)
    for group in GROUPS:
        for joint in roles.group(group):
            motor = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            # Torque in, torque out: control and motor physics are effects and not MuJoCo's.
            motor.set_to_motor()
    for i, loop in enumerate(loops):
        _add_connect(spec, f"loop_{i}", loop, description)
    for group in driven:
        for joint in group.joints[1:]:
            _add_tie(spec, f"{group.name}_{joint}", Coupling(joint, group.joints[0], 1.0, 0.0), description)
        for joint in group.joints:
            # One rotor turns with all wheels of the group.
            # Shared out, because the tie adds the wheels' inertias up again.
            spec.joint(joint).armature = spec.joint(joint).armature / len(group.joints)
    for coupling in couplings:
        _add_tie(spec, f"{coupling.follower}_follows_{coupling.leader}", coupling, description)
    return spec


def _add_body(
    parent: mujoco.MjsBody, body: Body, description: Description, roles: Roles, standing_height: float
) -> mujoco.MjsBody:
    # The base stands on the ground at zero angles, so that a scene can be looked at as it is.
    position = np.array([0.0, 0.0, standing_height]) if body.parent is None else body.pose.position
    added = parent.add_body(name=body.name, pos=position, quat=quaternion(body.pose.rotation))
    # From the URDF, never from the shapes, whose density MuJoCo would invent.
    added.explicitinertial = True
    added.mass, added.ipos = body.mass, body.com
    i = body.inertia
    added.fullinertia = [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]
    if body.joint is None:
        added.add_freejoint(name="free")
    else:
        slide = body.joint.kind == "prismatic"
        joint = added.add_joint(
            name=body.joint.name,
            type=mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE,
            axis=body.joint.axis,
            limited=mujoco.mjtLimited.mjLIMITED_FALSE,
        )
        _set_linear(joint, "damping", description.passive_damping)
        if np.isfinite(body.joint.limits).all():
            joint.range = body.joint.limits
        for name in GROUPS:
            if body.joint.name in roles.group(name):
                group = description.groups[name]
                # The rotor turns N times as fast, and its torque counts N times at the joint.
                joint.armature = group.rotor_inertia_kg_m2 * group.gear_ratio**2
                _set_linear(joint, "stiffness", group.stiffness)
                _set_linear(joint, "damping", group.damping)
                if isinstance(group.spring_reference, float):
                    joint.springref = group.spring_reference
    for shape in body.geometry:
        half = [s / 2 for s in shape.size] if shape.kind == "box" else [shape.size[0], 0.0, 0.0]
        if shape.kind == "cylinder":
            half[1] = shape.size[1] / 2
        # conaffinity without contype: the rover touches ground that is added to the scene, never itself.
        added.add_geom(
            type=_TYPES[shape.kind],
            size=half,
            pos=shape.pose.position,
            quat=quaternion(shape.pose.rotation),
            rgba=shape.rgba,
            # The shape is for looking and touching; the body's mass is explicit.
            mass=0.0,
            contype=0,
            conaffinity=1,
        )
    for link, pose in body.frames.items():
        if link != body.name:
            # Links that were fused keep their frames as sites: instruments are mounted there. Group 4 is hidden by
            # default.
            added.add_site(name=link, pos=pose.position, quat=quaternion(pose.rotation), group=4)
    return added


def _set_linear(joint: mujoco.MjsJoint, key: str, value: float) -> None:
    """Sets a stiffness or damping, which the spec holds as the three coefficients of a polynomial."""
    coefficients = np.array(getattr(joint, key))
    coefficients.flat[0] = value
    setattr(joint, key, coefficients)


def _add_connect(spec: mujoco.MjSpec, name: str, loop: PlacedLoop, description: Description) -> None:
    equality = spec.add_equality(name=name, type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY)
    equality.name1, equality.name2 = loop.body1, loop.body2
    data = np.zeros_like(equality.data)
    data[:3] = loop.anchor1
    equality.data = data
    equality.solref, equality.solimp = description.solref, description.solimp


def _add_tie(spec: mujoco.MjSpec, name: str, coupling: Coupling, description: Description) -> None:
    """A fixed ratio of two joints' angles: wheels behind one motor, a differential, a mimic."""
    equality = spec.add_equality(name=name, type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT)
    equality.name1, equality.name2 = coupling.follower, coupling.leader
    data = np.zeros_like(equality.data)
    data[:2] = coupling.offset, coupling.multiplier
    equality.data = data
    equality.solref, equality.solimp = description.solref, description.solimp


def ties(driven: tuple[DriveGroup, ...]) -> int:
    """Number of constraints that tie the wheels of groups together."""
    return sum(len(group.joints) - 1 for group in driven)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (4,), w first and not negative, of a rotation matrix (3, 3)."""
    result = np.zeros(4)
    mujoco.mju_mat2Quat(result, np.ascontiguousarray(rotation).reshape(9))
    # One sign of two that mean the same, so that files do not differ; 0.0 - x writes no -0.
    return result if result[0] >= 0 else 0.0 - result


def digits(values: np.ndarray | float) -> str:
    """Numbers as text with twelve significant digits: what is written and read again is the same model."""
    # Rounding of rotations leaves 1e-17 where zero is meant.
    cleaned = [0.0 if abs(v) < 1e-15 else float(v) for v in np.atleast_1d(values)]
    return " ".join(f"{v:.12g}" for v in cleaned)


def to_xml(spec: mujoco.MjSpec) -> str:
    """The spec as MJCF text; must have been compiled.

    MuJoCo's own writer keeps six digits, which would lose mass, so the numbers that matter are put back.
    """
    root = ET.fromstring(spec.to_xml())
    _spell_out_options(root, spec)
    bodies = {b.name: b for b in spec.bodies}
    joints = {j.name: j for j in spec.joints}
    for element in root.iter("body"):
        body = bodies[element.attrib["name"]]
        _put(element, "pos", body.pos, np.zeros(3))
        _put(element, "quat", body.quat, np.array([1.0, 0, 0, 0]))
        inertial = element.find("inertial")
        assert inertial is not None
        inertial.attrib.clear()
        inertial.set("pos", digits(body.ipos))
        inertial.set("mass", digits(body.mass))
        inertial.set("fullinertia", digits(body.fullinertia))
        for tag, sources in (("geom", body.geoms), ("site", body.sites)):
            for child, source in zip(element.findall(tag), sources, strict=True):
                _put(child, "pos", source.pos, np.zeros(3))
                _put(child, "quat", source.quat, np.array([1.0, 0, 0, 0]))
        for joint in element.findall("joint"):
            # MuJoCo writes free joints as <joint>, which then takes defaults such as armature; <freejoint> takes none.
            if joint.get("type") == "free":
                element.insert(list(element).index(joint), ET.Element("freejoint", {"name": joint.attrib["name"]}))
                element.remove(joint)
                continue
            source = joints[joint.attrib["name"]]
            _put(joint, "axis", source.axis, np.full(3, np.nan))
            _put(joint, "range", source.range, np.zeros(2))
            for key in ("armature", "damping", "stiffness", "springref"):
                _put(joint, key, np.ravel(getattr(source, key))[:1], np.zeros(1))
    for motor in root.findall("actuator/general"):
        # A plain motor written in full as <general> hides that it is one.
        motor.tag = "motor"
    ET.indent(root, "  ")
    return ET.tostring(root, encoding="unicode").replace(" />", "/>") + "\n"


def _spell_out_options(root: ET.Element, spec: mujoco.MjSpec) -> None:
    """Writes the options that the loop closures rely on, also where they are MuJoCo's defaults."""
    option = root.find("option")
    assert option is not None
    given = dict(option.attrib)
    option.attrib.clear()
    option.set("timestep", digits(spec.option.timestep))
    # Defaults may change with MuJoCo's version; the closures rely on these.
    option.attrib.update({"integrator": "Euler", "solver": "Newton", **given})


def _put(element: ET.Element, key: str, values: np.ndarray, default: np.ndarray) -> None:
    """Sets an attribute, or removes it where the value is the default."""
    if np.array_equal(np.asarray(values, dtype=float), default):
        element.attrib.pop(key, None)
    else:
        element.set(key, digits(values))


def scene_of(rover: str) -> str:
    """MJCF of a scene to look at the rover in MuJoCo's viewer: a plane, a low sun, contacts on."""
    return f"""<mujoco model="{rover} scene">
  <include file="{rover}.xml"/>

  <!-- The rover's file is made for the library, which computes contact itself; here MuJoCo does. -->
  <option iterations="100" ls_iterations="50">
    <flag contact="enable"/>
  </option>

  <statistic center="0 0 0.5" extent="2"/>

  <visual>
    <headlight diffuse="0.4 0.4 0.4" ambient="0.2 0.2 0.2" specular="0 0 0"/>
    <rgba haze="0 0 0 1"/>
  </visual>

  <asset>
    <texture type="skybox" builtin="flat" rgb1="0 0 0" rgb2="0 0 0" width="32" height="32"/>
    <texture type="2d" name="regolith" builtin="checker" rgb1="0.35 0.35 0.35" rgb2="0.3 0.3 0.3" width="300"
      height="300"/>
    <material name="regolith" texture="regolith" texuniform="true" texrepeat="1 1"/>
  </asset>

  <worldbody>
    <light name="sun" pos="-5 -5 3" dir="1 1 -0.6" directional="true"/>
    <geom name="ground" type="plane" size="0 0 0.05" material="regolith" contype="1" conaffinity="0"/>
  </worldbody>
</mujoco>
"""
