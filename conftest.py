"""Settings of every test process; they must stand before JAX is imported."""

import os

# Batched solves on few cores have hung inside XLA's thread pool with this on.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
os.environ.setdefault("MUJOCO_GL", "disable")
