"""Soil that slipping wheels throw up: grains on ballistic arcs, and how they veil a picture.

There is no air: a grain leaves the rim with at most the rim's own speed over the ground, flies a parabola and comes
down at once, so that sheets trail the wheels and no cloud stays behind (Hsu & Horanyi 2012, Ballistic motion of dust
particles in the Lunar Roving Vehicle dust trails, Am. J. Phys. 80, 452, from films of Apollo 16). It is for the eye
alone: nothing of it acts on the rover.
"""
