"""Rovers made for the tests of the structured engine: odd numbers of legs, oblique axes, general four-bars."""

from pathlib import Path

import numpy as np

from lunar_mjx.rover import Rover, Wheel
from lunar_mjx.rover.rover import JointGroup

_HEAD = """<mujoco model="{name}"><compiler angle="radian" autolimits="false"/>
<option timestep="0.002" integrator="Euler" gravity="0 0 -1.625"><flag contact="disable" limit="disable"/></option>
<worldbody><body name="chassis" pos="0 0 0.5"><freejoint name="free"/>
<inertial pos="0.03 -0.02 0.1" mass="40" fullinertia="3 4 5 0.2 -0.1 0.3"/>
<body name="mast" pos="0.2 0.1 0.4" quat="0.9 0.1 0.3 0.2"><inertial pos="0 0 0.3" mass="3" diaginertia=".1 .12 .02"/>
<body name="camera" pos="0 0 0.5"><inertial pos="0.02 0 0" mass="1" diaginertia=".01 .01 .02"/></body></body>
"""


def _rover(folder: Path, name: str, legs: str, tail: str, corners: list[str], joints: tuple[str, ...]) -> Rover:
    path = Path(folder) / f"{name}.xml"
    path.write_text(_HEAD.format(name=name) + legs + "</body></worldbody>" + tail + "</mujoco>")
    wheels = tuple(Wheel(c, f"{c}_wheel", 0.2, 0.1, f"{c}_drive", None, None) for c in corners)
    group = JointGroup("drive", joints, "torque", 0.0, 0.0, 1.0, 1.0, 0.0, 48)
    limits = dict.fromkeys(joints, (-np.inf, np.inf))
    return Rover(name, Path(folder), path, wheels, (group,), limits, "chassis", np.zeros((1, 3)), (), 0.0, 0.0)


def _vector(values) -> str:
    return " ".join(repr(float(v)) for v in values)


def spider(folder: Path, legs: int, links: int = 4, seed: int = 0) -> Rover:
    """`legs` legs of up to four hinges with oblique axes, joint anchors off the origin, springs and fixed bodies."""
    rng = np.random.default_rng(seed)
    text, corners = "", [f"l{i}" for i in range(legs)]
    for c in corners:
        close = ""
        for k in range(links):
            name = f"{c}_wheel" if k == links - 1 else f"{c}_{k}"
            joint = f"{c}_drive" if k == links - 1 else f"{c}_j{k}"
            quat = rng.normal(size=4)
            text += f"""<body name="{name}" pos="{_vector(rng.normal(size=3) * 0.3)}" quat="{_vector(quat)}">
<joint name="{joint}" axis="{_vector(rng.normal(size=3))}" pos="{_vector(rng.normal(size=3) * 0.05)}"
 damping="{rng.uniform(0, 3)}" stiffness="{rng.uniform(0, 50)}" springref="{rng.normal() * 0.3}"
 armature="{rng.uniform(0.01, 0.3)}"/>
<inertial pos="{_vector(rng.normal(size=3) * 0.1)}" mass="{rng.uniform(0.5, 3)}" quat="{_vector(rng.normal(size=4))}"
 diaginertia="{_vector(rng.uniform(0.02, 0.03, 3))}"/>
<body pos="{_vector(rng.normal(size=3) * 0.1)}"><inertial pos="0 0 0" mass="0.3" diaginertia=".01 .01 .01"/></body>
"""
            close += "</body>"
        text += close
    joints = tuple(f"{c}_drive" for c in corners) + tuple(f"{c}_j0" for c in corners if links > 1)
    return _rover(folder, f"spider_{legs}_{links}", text, "", corners, joints)


def mixed(folder: Path) -> Rover:
    """Two patterns of legs: four steered wheels, and two on an arm without steering, listed in alternating order."""
    text, corners = "", ["lf", "rf", "lm", "rm", "lr", "rr"]
    for i, c in enumerate(corners):
        x, y = (0.6, 0.0, -0.6)[i // 2], 0.4 if i % 2 == 0 else -0.4
        arm = f"""<body pos="{x} {y} 0"><joint name="{c}_arm" axis="0 {1 if y > 0 else -1} 0"
 damping="5" stiffness="100"/>
<inertial pos="0.1 0 0" mass="2" diaginertia=".01 .02 .02"/>"""
        knuckle = f"""<body pos="0.2 0 -0.1"><joint name="{c}_steer" axis="0 0 1" armature="0.1"/>
<inertial pos="0 0.02 0" mass="1" diaginertia=".01 .01 .01"/>"""
        wheel = f"""<body name="{c}_wheel" pos="0 0.1 0"><joint name="{c}_drive" axis="0 1 0" armature="0.05"/>
<inertial pos="0 0 0" mass="3" diaginertia=".03 .05 .03"/></body>"""
        text += arm + (wheel if c[1] == "m" else knuckle + wheel + "</body>") + "</body>"
    steered = [c for c in corners if c[1] != "m"]
    joints = tuple(f"{c}_drive" for c in corners) + tuple(f"{c}_steer" for c in steered)
    return _rover(folder, "mixed", text, "", corners, joints)


def fourbar(folder: Path, driven: str = "lower", solref: float = 0.004, damping: float = 2.0) -> Rover:
    """Two legs (left and right) with a general four-bar (all sides differ); the joint `driven` is actuated.

    The pin's place on the upper arm follows from the coupler's at zero angles. `driven`: lower, coupler or upper.
    """
    text, tail, corners = "", "", ["lf", "rf", "lr"]
    for i, c in enumerate(corners):
        x, side = (0.5, 0.5, -0.5)[i], (1, -1, 1)[i]
        axis = f"{-side} 0 0" if i < 2 else "1 0 0"
        text += f"""<body name="{c}_lower" pos="{x} {0.2 * side} -0.06">
<joint name="{c}_lower" axis="{axis}" stiffness="80" springref="0.1" damping="{damping}" armature="0.2"/>
<inertial pos="0 {0.16 * side} 0.01" mass="4" diaginertia=".05 .01 .05"/>
<body name="{c}_upright" pos="0 {0.32 * side} 0.01"><joint name="{c}_coupler" axis="1 0 0"
 damping="{damping / 4}" armature="0.02"/>
<inertial pos="0 0.01 0.05" mass="2" diaginertia=".01 .01 .004"/>
<body name="{c}_wheel" pos="0 {0.1 * side} -0.05"><joint name="{c}_drive" axis="0 1 0" armature="0.05"/>
<inertial pos="0 0 0" mass="6" diaginertia=".1 .2 .1"/></body></body></body>
<body name="{c}_upper" pos="{x} {0.22 * side} 0.05"><joint name="{c}_upper" axis="{axis}"
 stiffness="20" armature="0.03"/>
<inertial pos="0 {0.12 * side} 0" mass="1.5" diaginertia=".02 .002 .02"/></body>"""
        tail += (
            f'<connect body1="{c}_upright" body2="{c}_upper" anchor="0 {-0.03 * side} 0.14" '
            f'solref="{solref}" solimp="0.999 0.999"/>'
        )
    joints = tuple(f"{c}_drive" for c in corners) + tuple(f"{c}_{driven}" for c in corners)
    name = f"fourbar_{driven}"
    return _rover(folder, name, text, f"<equality>{tail}</equality>", corners, joints)
