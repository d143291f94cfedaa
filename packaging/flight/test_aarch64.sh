#!/usr/bin/env bash
# Runs the flight software's tests on an emulated 64-bit ARM processor: packaging/flight/test_aarch64.sh [arguments of pytest]
# Without arguments: the tests of frames, packets, transfer, orbit and store, some ten minutes.
# Takes Debian's arm64 Python 3.11 and the wheels for aarch64 into a folder of the cache; nothing is installed on this
# machine. Needs Debian's qemu-user-static (as qemu-aarch64-static), apt-get, dpkg and this repository's .venv.
set -euo pipefail
cd "$(dirname "$0")/../.."
command -v qemu-aarch64-static >/dev/null || { echo "qemu-aarch64-static is missing: apt-get install qemu-user-static" >&2; exit 2; }
python=$PWD/.venv/bin/python
cache=${XDG_CACHE_HOME:-$HOME/.cache}/obbgs-tests/aarch64

if [ ! -x "$cache/root/usr/bin/python3.11" ]; then
  mkdir -p "$cache"/apt/state/lists/partial "$cache"/apt/cache/archives/partial
  touch "$cache/apt/status"
  printf '%s\n' 'APT::Architecture "arm64"; APT::Architectures { "arm64"; };' \
    "Dir::State \"$cache/apt/state\"; Dir::State::status \"$cache/apt/status\"; Dir::Cache \"$cache/apt/cache\";" >"$cache/apt.conf"
  export APT_CONFIG=$cache/apt.conf
  apt-get -qq update
  apt-get -qq -y -d --no-install-recommends install python3.11 libstdc++6
  for package in "$cache"/apt/cache/archives/*.deb; do dpkg -x "$package" "$cache/root"; done
fi

wheel=$(mktemp -d)
trap 'rm -rf "$wheel"' EXIT
(cd packaging/flight && "$python" -c "from hatchling.build import build_wheel; build_wheel('$wheel')" >/dev/null)
rm -rf "$cache/site" "$cache/tests"
"$python" -m pip install -q --disable-pip-version-check --no-warn-conflicts --target "$cache/site" --only-binary=:all: --python-version 3.11 \
  --platform manylinux2014_aarch64 --platform manylinux_2_27_aarch64 --platform manylinux_2_28_aarch64 \
  "$wheel"/*.whl onnxruntime pytest pytest-timeout hypothesis skyfield skyfield-data imagecodecs
mkdir "$cache/tests" && cp -r tests mission.yaml "$cache/tests" # away from the repository: only the wheel is imported

cd "$cache/tests"
[ $# -gt 0 ] || set -- tests/flightsw/icd/test_frame.py tests/flightsw/icd/test_packet.py tests/flightsw/icd/test_transfer.py \
  tests/flightsw/test_orbit.py tests/flightsw/test_store.py -k "not kill_at_any_moment" # starts Python itself, not emulated
PYTHONDONTWRITEBYTECODE=1 PYTHONPATH=$cache/site OPENBLAS_NUM_THREADS=1 qemu-aarch64-static -L "$cache/root" \
  "$cache/root/usr/bin/python3.11" -m pytest -q -p no:cacheprovider --import-mode=importlib -W error --rootdir "$PWD" "$@"
