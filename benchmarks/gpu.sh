#!/usr/bin/env bash
# Hold every operation, step and fusion on a GPU against the CPU, then time them: benchmarks/gpu.sh [OUT]. Under 6 minutes.
#
# Runs from a bare machine with torch for CUDA: what pcdata needs besides is installed from wheels/ (fill it where there
# is a network: benchmarks/gpu.sh --fetch) or from the index. OUT (results/ by default) receives gpu.json.
set -euo pipefail
cd "$(dirname "$0")/.."
packages=(pydantic pyyaml pillow tqdm pytest)

if [ "${1:-}" = --fetch ]; then
    for python in 3.10 3.11 3.12 3.13; do
        python3 -m pip download -q --only-binary :all: --python-version "$python" --platform manylinux2014_x86_64 -d wheels "${packages[@]}"
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
nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader || true
PYTHONPATH=. PYTHONUNBUFFERED=1 python3 benchmarks/gpu.py --out "$out/gpu.json" "${@:2}"
