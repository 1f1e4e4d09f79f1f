#!/usr/bin/env bash
# Hold every operation, step and fusion on a GPU against the CPU, then time them: benchmarks/gpu.sh [OUT]. Under 6 minutes.
#
# Runs from a bare machine with torch for CUDA: what pcdata needs besides is installed from wheels/ (fill it where there
# is a network: benchmarks/gpu.sh --fetch [PYTHON VERSIONS, all by default]) or from the index. Kernels need cuda-core, NVRTC and
# cuda-bindings; torch for CUDA brings the last two, and without the first the references run and the log says so.
# OUT (results/ by default) receives gpu.json.
set -euo pipefail
cd "$(dirname "$0")/.."
packages=(pydantic pyyaml pillow tqdm pytest)
kernels=(cuda-core cuda-pathfinder) # without what they need: torch pins its own version of that

if [ "${1:-}" = --fetch ]; then
    shift
    [ $# -gt 0 ] || set -- 3.10 3.11 3.12 3.13
    for python in "$@"; do
        fetch=(python3 -m pip download -q --only-binary :all: --python-version "$python" --platform manylinux2014_x86_64 -d wheels)
        "${fetch[@]}" "${packages[@]}"
        "${fetch[@]}" --platform manylinux_2_28_x86_64 --no-deps "${kernels[@]}"
    done
    du -sh wheels
    exit
fi

out=${1:-benchmarks/results}
from=()
[ -d wheels ] && from=(--no-index --find-links wheels)
for package in "${packages[@]}"; do
    module=${package/pyyaml/yaml}
    python3 -c "import ${module/pillow/PIL}" 2>/dev/null || python3 -m pip install -q --break-system-packages "${from[@]}" "$package"
done
python3 -c "import cuda.core" 2>/dev/null ||
    python3 -m pip install -q --break-system-packages "${from[@]}" --no-deps "${kernels[@]}" || true # told of below
nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader || true
PYTHONPATH=. PYTHONUNBUFFERED=1 python3 benchmarks/gpu.py --out "$out/gpu.json" "${@:2}"
