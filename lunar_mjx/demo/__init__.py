"""The main job in one command: drive a batch of rovers, and hold the wheel model against measurements."""

from lunar_mjx.demo.run import run_demo as run_demo
