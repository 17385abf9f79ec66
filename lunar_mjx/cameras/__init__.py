"""Cameras: pictures through MuJoCo's renderer, and depth and height images of thousands of rovers in pure JAX."""

from lunar_mjx.cameras.camera import LABELS, Images, RoverCamera
from lunar_mjx.cameras.mount import facing, front_mount
from lunar_mjx.cameras.pinhole import Pinhole, Pose, look_at, orbit, project
from lunar_mjx.cameras.raymarch import depth_image, depth_images, height_scan, mounted
from lunar_mjx.cameras.scene import Sun
from lunar_mjx.cameras.texture import Track

__all__ = [
    "LABELS",
    "Images",
    "Pinhole",
    "Pose",
    "RoverCamera",
    "Sun",
    "Track",
    "depth_image",
    "depth_images",
    "facing",
    "front_mount",
    "height_scan",
    "look_at",
    "mounted",
    "orbit",
    "project",
]
