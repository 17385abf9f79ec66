"""Settings of every test process; they must stand before JAX is imported."""

import gc
import os

# Batched solves on few cores have hung inside XLA's thread pool with this on.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
os.environ.setdefault("MUJOCO_GL", "disable")
# Two test processes on two processors: a second thread of either would wait for the other process, and spin meanwhile.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Tracing makes objects by the million and hardly any cycles: by default they are searched every 700 objects.
gc.set_threshold(100_000, 20, 50)
