#!/bin/sh
# One H100 or H200, at most 330 s: one kernel beside XLA and the gated programs. Needs $OUT, CuPy, mujoco. All programs
# compile side by side, and are timed one at a time under a lock.
set -u
export XLA_PYTHON_CLIENT_PREALLOCATE=false MUJOCO_GL=disable PYTHONPATH="$PWD:$PWD/benchmarks${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1
nvidia-smi --query-gpu=name,clocks.sm,clocks.max.sm --format=csv,noheader
python3 -c "import jax, cupy, mujoco; print(jax.__version__, cupy.__version__, mujoco.__version__, jax.devices())" || exit 2
C=${COMMIT:-unknown}; L="--lock /tmp/i25.lock --commit $C"
FAST='[[128, 1, ["--use_fast_math"]]]'
timeout 200 python3 benchmarks/one_kernel.py $L --limit 190 --rows luvmi_x,consistent,65536 --out "$OUT/kernel_lc.json" &
timeout 200 python3 benchmarks/one_kernel.py $L --limit 190 --rows viper,consistent,65536 --out "$OUT/kernel_vc.json" &
timeout 320 python3 benchmarks/one_kernel.py $L --limit 310 --rows luvmi_x,field,65536 --variants "$FAST" --out "$OUT/kernel_lf.json" &
timeout 320 python3 benchmarks/one_kernel.py $L --limit 310 --rows viper,field,65536 --variants "$FAST" --out "$OUT/kernel_vf.json" &
timeout 300 python3 benchmarks/programs.py $L --batches 65536 --only "field;consistent" --out "$OUT/programs_65536.json" &
timeout 300 python3 benchmarks/programs.py $L --batches 8192 --rovers luvmi_x --only "field;field, ruts" --out "$OUT/ruts_l.json" &
timeout 300 python3 benchmarks/programs.py $L --batches 8192 --rovers viper --only "field;field, ruts" --out "$OUT/ruts_v.json" &
wait
ls -l "$OUT"
