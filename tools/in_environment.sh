#!/usr/bin/env bash
# Run a command in the suite's environment: tools/in_environment.sh COMMAND [ARGUMENT ...]
# Other scripts source this file for enter_environment.

# Make bin/, libraries and messages of the environment the first to be found. With ROS from wheels,
# the variables of another ROS are taken away: mixing two ends in missing symbols.
enter_environment() {
  local prefix=$1 system_ros=$2
  if [[ $system_ros == 1 ]]; then
    export LD_LIBRARY_PATH="$prefix/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
  else
    if [[ -n ${AMENT_PREFIX_PATH:-}${_ROS_WHEELS_BOOTSTRAP_COMPLETE:-} ]]; then
      unset LD_LIBRARY_PATH
    fi
    unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH PYTHONPATH RMW_IMPLEMENTATION
    unset ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION _ROS_WHEELS_BOOTSTRAP_COMPLETE
  fi
  unset PYTHONHOME
  export AMENT_PREFIX_PATH="$prefix${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}"
  export CMAKE_PREFIX_PATH="$prefix${CMAKE_PREFIX_PATH:+:$CMAKE_PREFIX_PATH}"
  export VIRTUAL_ENV=$prefix PATH="$prefix/bin:$PATH"
}

if [[ ${BASH_SOURCE[0]} == "$0" ]]; then
  set -euo pipefail
  root=$(cd "$(dirname "$0")/.." && pwd -P)
  prefix=$(realpath -ms "${VENV:-$root/.venv}")
  if [[ ! -f $prefix/.setup/system_ros ]]; then
    echo "error: no environment in $prefix: run make setup" >&2
    exit 1
  fi
  enter_environment "$prefix" "$(< "$prefix/.setup/system_ros")"
  exec "$@"
fi
