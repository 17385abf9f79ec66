"""Compiled programs on disk: a step compiles for tens of seconds, and the next command need not do it again."""

from __future__ import annotations

import os
from pathlib import Path


def keep_compiled() -> None:
    """Lets JAX keep compiled programs in the user's cache, unless the environment names another place."""
    import jax

    # The user's own choice wins.
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
        jax.config.update("jax_compilation_cache_dir", str(home / "lunar-mjx" / "jax"))
        # What compiles faster is not worth a file.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
