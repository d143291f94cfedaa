#!/usr/bin/env bash
# Sets up from nothing: system libraries, the product's environment with its compiled module, and Blender.
# Idempotent: what is up to date is left alone. PYTHON names another interpreter (3.11 to 3.14), PIP_ARGS adds arguments to pip.
set -euo pipefail
cd "$(dirname "$0")"
[ "$(uname -s)" = Linux ] || {
  echo "setup: this sets up Linux, and $(uname -s) was never tried; \`pip install -c constraints.txt -e '.[dev]'\` may do for" \
    "all but the simulator, which needs a \`blender\` on the PATH" >&2
  exit 2
}

supported() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' 2>/dev/null; }
python=${PYTHON:-}
for name in python3.11 python3 python3.13 python3.12 python3.14; do
  if [ -z "$python" ] && supported "$name"; then python=$(command -v "$name"); fi
done
[ -n "$python" ] || { echo "setup: no Python from 3.11 to 3.14 found; install one: apt-get install python3 python3-venv python3-dev" >&2; exit 2; }
supported "$python" || {
  echo "setup: Python 3.11 to 3.14 is needed, $python is $("$python" -V 2>&1); set PYTHON=/path/to/python3" >&2; exit 2; }

# name of the Debian package = what proves that it is there
missing=()
needs() { eval "$2" >/dev/null 2>&1 || missing+=("$1"); }
libraries=$({ ldconfig -p || /sbin/ldconfig -p; } 2>/dev/null) || true
library() { needs "$1" "[[ \$libraries == *'$2'* ]]"; }
needs g++ "command -v g++"
needs python3-venv "'$python' -c 'import ensurepip'"
needs python3-dev "test -f \"\$('$python' -c 'import sysconfig; print(sysconfig.get_path(\"include\"))')/Python.h\""
library libx11-6 libX11.so.6
library libxrender1 libXrender.so.1
library libxfixes3 libXfixes.so.3
library libxi6 libXi.so.6
library libxkbcommon0 libxkbcommon.so.0
library libsm6 libSM.so.6
library libgl1 libGL.so.1
library libaravis-0.8-0 libaravis-0.8.so.0
needs aravis-tools "command -v arv-fake-gv-camera-0.8"
if [ ${#missing[@]} -gt 0 ]; then
  install="apt-get install -y --no-install-recommends ${missing[*]}"
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "setup: $install"
    apt-get update -qq && $install >/dev/null
  else
    echo "setup: system packages are missing; on Debian or Ubuntu run: sudo $install" >&2
    exit 2
  fi
fi

# A stamp holds the digest of everything that shaped an environment; a changed input sets it up again.
environment() { # directory, its Python, files that shape it, command that fills it
  local dir=$1 own=$2 inputs=$3 fill=$4 digest
  digest=$({ "$own" -V; cat $inputs; echo "$fill"; pwd; } | sha256sum)
  [ "$(cat "$dir/.ready" 2>/dev/null)" = "$digest" ] && return
  echo "setup: $dir (downloads on the first run)"
  # an environment of another Python is made anew
  "$dir/bin/python" -m pip --version >/dev/null 2>&1 && [ "$("$dir/bin/python" -V)" = "$("$own" -V)" ] || "$own" -m venv --clear "$dir"
  eval "$fill" || {
    echo "setup: $dir is not complete: pip says above what it could not install for $("$own" -V) on $machine. Python 3.11 to" \
      "3.13 on x86_64 have every package; PYTHON=/path/to/python3 takes another" >&2
    exit 2
  }
  echo "$digest" >"$dir/.ready"
}

machine=$(uname -m)
pip_args="-q --disable-pip-version-check ${PIP_ARGS:-}"
modules=$(find flightsw obbgs_base obbgs_core ground compare hil -name '*.py' | sort | sha256sum | cut -c1-16)
environment .venv "$python" "pyproject.toml constraints.txt CMakeLists.txt $(find obbgs_core/render/kernels -type f -not -name '*.pyc' | sort | tr '\n' ' ')" \
  ".venv/bin/pip install $pip_args -c constraints.txt -e '.[dev]' # modules $modules, which an editable installation lists"

# Blender comes as the package bpy, which exists for some Pythons on x86_64 only; else it is a `blender` that is there; else
# bpy in a Python 3.11 of uv's. hil/sky/blender.py looks for it in this order, too.
has_bpy() { [ "$machine" = x86_64 ] && "$1" -c 'import sys, ensurepip; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 13)))' >/dev/null 2>&1; }
blender_python=
for name in "$python" python3.11 python3.13; do
  if [ -z "$blender_python" ] && has_bpy "$name"; then blender_python=$(command -v "$name"); fi
done
blender_version() { blender --version 2>/dev/null | sed -n 's/^Blender \([0-9]*\)\.\([0-9]*\).*/\1 \2/p' | head -1; }
read -r major minor < <(blender_version) || true
if [ -z "$blender_python" ] && [ "$((${major:-0} * 100 + ${minor:-0}))" -ge 401 ]; then
  echo "setup: Blender is $(command -v blender), $major.$minor; there is no bpy for $("$python" -V) on $machine"
  exit 0
fi
if [ -z "$blender_python" ] && [ "$machine" = x86_64 ] && command -v uv >/dev/null && uv python install -q 3.11; then
  blender_python=$(uv python find 3.11)
fi
if [ -z "$blender_python" ]; then
  others=", no python3.11 or python3.13 with venv, and no uv that can install Python 3.11"
  [ "$machine" = x86_64 ] || others=""
  echo "setup: everything but Blender is ready: no \`blender\` of 4.1 or newer is on the PATH, there is no bpy for" \
    "$("$python" -V) on $machine$others. Provide one of them, such as \`apt-get install blender python3-numpy\` on Debian" \
    "13; without it the simulator cannot render" >&2
  exit 2
fi
environment .venv-blender "$blender_python" "hil/blender-requirements.txt" \
  ".venv-blender/bin/pip install $pip_args -r hil/blender-requirements.txt"
