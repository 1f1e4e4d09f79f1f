#!/usr/bin/env bash
# Bundle src/ and three.js, of the version that package-lock.json pins, into viewer.js, which the package carries.
# Needs node and the npm registry; only for work on the viewer. The same sources give the same bytes.
set -euo pipefail
cd "$(dirname "$0")"
npm ci --no-audit --no-fund --loglevel=error
npm run --silent bundle
cp node_modules/three/LICENSE THREE-LICENSE.txt
