#!/usr/bin/env bash
# One step of `make setup`: tools/setup.sh environment|dependencies|messages|packages|colcon [PACKAGE ...]
# The Makefile knows when a step is due. Variables: VENV, PYTHON, TORCH_INDEX, SYSTEM_ROS.
set -euo pipefail
cd "$(dirname "$0")/.."
source tools/in_environment.sh
source tools/prerequisites.sh

prefix=$(realpath -ms "${VENV:-.venv}")
stamps=$prefix/.setup

fail() {
  echo "error: $*" >&2
  exit 1
}

say() {
  printf '== %s\n' "$*"
}

# The environment remembers where its ROS comes from; a new one takes SYSTEM_ROS, or what is sourced.
choose_ros() {
  local kept
  kept=$(cat "$stamps/system_ros" 2> /dev/null || true)
  if [[ -n $kept && -n ${SYSTEM_ROS:-} && $kept != "$SYSTEM_ROS" ]]; then
    fail "$prefix was made with SYSTEM_ROS=$kept, not $SYSTEM_ROS: make distclean first"
  fi
  system_ros=${kept:-${SYSTEM_ROS:-}}
  if [[ -z $system_ros ]]; then
    [[ ${ROS_DISTRO:-} == jazzy && -n ${AMENT_PREFIX_PATH:-} ]] && system_ros=1 || system_ros=0
  fi
  if [[ $system_ros == 1 && ( ${ROS_DISTRO:-} != jazzy || -z ${AMENT_PREFIX_PATH:-} ) ]]; then
    fail 'SYSTEM_ROS=1 needs a sourced ROS 2 Jazzy: source /opt/ros/jazzy/setup.bash first'
  fi
}

enter() {
  choose_ros
  enter_environment "$prefix" "$system_ros"
}

pip_install() {
  local quiet=--quiet
  [[ -t 1 ]] && quiet=
  python -m pip install --disable-pip-version-check $quiet "$@" \
    || fail "pip could not install the above: see its message (network? disk?), then run make again"
}

step_environment() {
  local base options=()
  choose_ros
  if [[ $system_ros == 1 ]]; then
    options=(--system-site-packages)
  elif [[ $(uname -m) != x86_64 ]]; then
    fail "ROS wheels are for x86_64, this is $(uname -m): source a ROS 2 Jazzy installation, then run make again"
  fi
  base=$(find_python "$system_ros")
  check_prerequisites "$base"
  if grep -qsF "$prefix/bin/" "$prefix/bin/pip"; then
    if [[ -n ${PYTHON:-} && $(python_version "$prefix/bin/python") != $(python_version "$base") ]]; then
      fail "$prefix has Python $(python_version "$prefix/bin/python"), PYTHON=$PYTHON is another: make distclean first"
    fi
  else
    if [[ -e $prefix && ! -f $prefix/pyvenv.cfg ]]; then
      fail "$prefix exists and is no Python environment: choose another place with VENV="
    fi
    say "environment in $prefix with Python $(python_version "$base") ($base)"
    rm -rf "$prefix"
    "$base" -m venv "${options[@]}" "$prefix" \
      || fail "$base -m venv failed: sudo apt install python$(python_version "$base")-venv"
  fi
  touch "$prefix/COLCON_IGNORE"
  mkdir -p "$stamps"
  echo "$system_ros" > "$stamps/system_ros"
}

step_dependencies() {
  local files=(core build dev torch-needs) torch_from=() kept index
  enter
  check_prerequisites "$prefix/bin/python"
  [[ $system_ros == 1 ]] || files+=(ros ros-build)
  kept=$(cat "$stamps/torch_index" 2> /dev/null || true)
  index=${TORCH_INDEX:-$kept}
  [[ -z $index ]] || torch_from=(--index-url "$index")
  [[ $index == "$kept" ]] || python -m pip uninstall --yes --quiet torch 2> /dev/null || true
  say 'Python packages, ROS among them: about 600 MB the first time, some minutes'
  files=("${files[@]/#/--requirement=requirements/}")
  pip_install "${files[@]/%/.txt}"
  say 'torch: 200 MB as CPU build, several GB as CUDA build (TORCH_INDEX= chooses)'
  pip_install "${torch_from[@]}" --requirement requirements/torch.txt
  printf '%s' "$index" > "$stamps/torch_index"
}

# Build an interface package and install it into the environment, as if it had come as a wheel.
generate() {
  local source=$1 name build manifest
  name=$(basename "$source")
  build=$stamps/build/$name manifest=$stamps/build/$name/install_manifest.txt
  mkdir -p "$build"
  [[ -f $manifest ]] && cp "$manifest" "$build/installed.txt"
  {
    cmake -S "$source" -B "$build" -DCMAKE_BUILD_TYPE=Release -DCMAKE_INSTALL_PREFIX="$prefix" \
      -DPython3_EXECUTABLE="$prefix/bin/python" -DBUILD_TESTING=OFF \
      && cmake --build "$build" --parallel "$(nproc)" \
      && cmake --install "$build"
  } > "$build/log.txt" 2>&1 || {
    tail -n 25 "$build/log.txt" >&2
    fail "$name could not be generated; the whole log is $build/log.txt"
  }
  # A message that is gone from the source must not stay importable.
  if [[ -f $build/installed.txt ]]; then
    grep -vxFf "$manifest" "$build/installed.txt" | while read -r stale; do rm -f "$stale"; done || true
  fi
}

step_messages() {
  enter
  # The standard /tf message, where ROS comes without it.
  if [[ -d $stamps/build/tf2_msgs ]] || ! python -c 'import tf2_msgs.msg' 2> /dev/null; then
    set -- tools/tf2_msgs "$@"
  fi
  for source in "$@"; do
    say "messages of $(basename "$source"): half a minute at most"
    generate "$source"
  done
}

step_packages() {
  enter
  say "$*: installed editable, so that edits count"
  local editable=()
  for package in "$@"; do editable+=(--editable "./$package"); done
  pip_install --quiet --no-deps --no-build-isolation --use-pep517 \
    --config-settings editable_mode=compat "${editable[@]}"
  # An editable install leaves out the data files: link what ROS looks for.
  local index=$prefix/share/ament_index/resource_index/packages
  mkdir -p "$index"
  for package in "$@"; do
    mkdir -p "$prefix/share/$package"
    ln -sfn "$PWD/$package/resource/$package" "$index/$package"
    ln -sfn "$PWD/$package/package.xml" "$PWD/$package/config" "$prefix/share/$package/"
  done
}

step_colcon() {
  enter
  # Here even beside a system colcon: executables run with the Python of the colcon that built them.
  say 'colcon: a few seconds'
  pip_install --requirement requirements/colcon.txt
}

step=${1:?which step?}
shift
case $step in
  environment | dependencies | messages | packages | colcon) "step_$step" "$@" ;;
  *) fail "unknown step '$step'" ;;
esac
touch "$stamps/$step"
