#!/usr/bin/env bash
# Build every package with colcon and check what came out. `make colcon` calls this in the environment.
set -euo pipefail
cd "$(dirname "$0")/.."

expected=$(for file in */package.xml; do dirname "$file"; done | sort)
found=$(colcon list --names-only | sort)
if [[ $found != "$expected" ]]; then
  echo "error: colcon sees these packages: $(tr '\n' ' ' <<< "$found")- expected: $(tr '\n' ' ' <<< "$expected")" >&2
  exit 1
fi

colcon build \
  --cmake-args -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=OFF -DPython3_EXECUTABLE="$(command -v python)"

set +u # colcon's setup files read variables that may be unset
source install/local_setup.bash
set -u
# shellcheck disable=SC2086
python tools/check_install_space.py install $expected
