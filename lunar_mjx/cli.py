"""Entry point of the command `lunar-mjx`."""

from lunar_mjx.commands.app import app as app
from lunar_mjx.commands.app import main as main

if __name__ == "__main__":
    main()
