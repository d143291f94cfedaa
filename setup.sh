#!/usr/bin/env bash
# Sets up from nothing: system libraries, the product's environment with its compiled module, and Blender's own environment.
# Idempotent: what is up to date is left alone. PYTHON names another interpreter (3.11), PIP_ARGS adds arguments to pip.
set -euo pipefail
cd "$(dirname "$0")"

python=${PYTHON:-$(command -v python3.11 || command -v python3 || true)}
[ -n "$python" ] || { echo "setup: no python3.11 found; install it: apt-get install python3.11 python3-venv python3-dev" >&2; exit 2; }
"$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || {
  echo "setup: Python 3.11 is needed (bpy 4.5 has no other build), $python is $("$python" -V); set PYTHON=/path/to/python3.11" >&2; exit 2; }

# name of the Debian package = what proves that it is there
missing=()
needs() { eval "$2" >/dev/null 2>&1 || missing+=("$1"); }
library() { needs "$1" "{ ldconfig -p || /sbin/ldconfig -p; } 2>/dev/null | grep -q '$2'"; }
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
    echo "setup: system packages are missing; run: sudo $install" >&2
    exit 2
  fi
fi

# A stamp holds the digest of everything that shaped an environment; a changed input sets it up again.
environment() { # directory, files that shape it, command that fills it
  local dir=$1 inputs=$2 fill=$3 digest
  digest=$({ "$python" -V; cat $inputs; echo "$fill"; pwd; } | sha256sum)
  [ "$(cat "$dir/.ready" 2>/dev/null)" = "$digest" ] && return
  echo "setup: $dir (downloads on the first run)"
  [ -x "$dir/bin/pip" ] || "$python" -m venv "$dir"
  eval "$fill"
  echo "$digest" >"$dir/.ready"
}

pip_args="-q --disable-pip-version-check ${PIP_ARGS:-}"
environment .venv "pyproject.toml constraints.txt CMakeLists.txt $(find obbgs_core/render/kernels -type f -not -name '*.pyc' | sort | tr '\n' ' ')" \
  ".venv/bin/pip install $pip_args -c constraints.txt -e '.[dev]'"
environment .venv-blender "hil/blender-requirements.txt" \
  ".venv-blender/bin/pip install $pip_args -r hil/blender-requirements.txt"
