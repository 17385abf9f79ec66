"""The LunarNav ladder: five rungs of navigation, each a distribution of worlds, from open ground to boulder mazes."""
