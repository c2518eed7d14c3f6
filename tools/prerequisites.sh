#!/usr/bin/env bash
# What has to be there before anything is downloaded. Sourced by setup.sh.

python_version() {
  "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2> /dev/null
}

# Print the Python of the environment: PYTHON, or the first that runs and is 3.11 or 3.12.
find_python() {
  local system_ros=$1 candidate version tried=()
  for candidate in ${PYTHON:-python3.12 python3.11 python3}; do
    version=$(python_version "$candidate") || version='does not run'
    if [[ $version != 3.11 && $version != 3.12 ]]; then
      tried+=("$candidate: $version")
    elif [[ $system_ros == 1 ]] && ! "$candidate" -c 'import rclpy' 2> /dev/null; then
      tried+=("$candidate: cannot import rclpy of the sourced ROS")
    else
      command -v "$candidate"
      return
    fi
  done
  local IFS=';'
  fail "Python 3.11 or 3.12 is needed (${tried[*]}): sudo apt install python3 python3-venv python3-dev, or name one with PYTHON="
}

# End in one line that names every missing Debian/Ubuntu package.
check_prerequisites() {
  local python=$1 version missing=() packages=()
  version=$(python_version "$python")
  need() {  # WHAT PACKAGE COMMAND...: the command succeeds when it is there
    local what=$1 package=$2
    shift 2
    if ! "$@" > /dev/null 2>&1; then
      missing+=("$what")
      packages+=("$package")
    fi
  }
  need 'a C++ compiler' g++ command -v ${CXX:-c++}
  need cmake cmake cmake --version
  need "Python's venv" "python$version-venv" "$python" -c 'import ensurepip, venv'
  need 'Python.h' "python$version-dev" "$python" -c \
    'import os, sysconfig; os.stat(sysconfig.get_path("include") + "/Python.h")'
  local library
  for library in libusb-1.0.so.0=libusb-1.0-0 libGL.so.1=libgl1 libgomp.so.1=libgomp1; do
    need "${library%%=*}" "${library#*=}" "$python" -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' \
      "${library%%=*}"
  done
  if [[ ${#missing[@]} -gt 0 ]]; then
    local list
    printf -v list '%s, ' "${missing[@]}"
    fail "missing ${list%, }: sudo apt install ${packages[*]}"
  fi
}
