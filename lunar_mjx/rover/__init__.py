"""Rovers: conversion of a URDF into MJCF, and loading of a converted rover by name or path."""

from lunar_mjx.rover.convert import convert
from lunar_mjx.rover.load import list_rovers, load_rover
from lunar_mjx.rover.rover import JointGroup, Loop, Rover, Wheel

__all__ = ["JointGroup", "Loop", "Rover", "Wheel", "convert", "list_rovers", "load_rover"]
