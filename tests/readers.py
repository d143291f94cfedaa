"""Other people's programs that read and draw models of Gaussian splats, from npm; skips where npm cannot bring them.

They are installed once into a folder of the user's cache, outside the repository, without running their scripts.
Under the MIT licence: gsplat.js, Spark (with three.js), and PlayCanvas' splat-transform, with SuperSplat's viewer;
under Apache 2.0: Babylon.js and Khronos' glTF validator.
"""

import contextlib
import fcntl
import functools
import hashlib
import http.server
import json
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGES = {
    "gsplat": "1.2.9",
    "@sparkjsdev/spark": "2.2.0",
    "three": "0.180.0",
    "@playcanvas/splat-transform": "2.7.1",
    "babylonjs": "9.28.0",
    "babylonjs-loaders": "9.28.0",
    "gltf-validator": "2.0.0-dev.3.10",
}
INSTALL_S = 300.0


def installed() -> Path:
    """Return the folder that holds node_modules with the packages; skip the test if they cannot be had."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node and npm are missing: apt-get install nodejs npm")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "obbgs-tests"
    wanted = json.dumps({"private": True, "dependencies": PACKAGES}, sort_keys=True)
    folder = cache / f"readers-{hashlib.sha256(wanted.encode()).hexdigest()[:12]}"
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "lock", "wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "complete").exists():
            (folder / "package.json").write_text(wanted)
            command = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", "--omit=optional"]
            try:
                done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=INSTALL_S)
                reason = (
                    "" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["no reason"])[0]
                )
            except subprocess.TimeoutExpired:
                reason = f"no answer in {INSTALL_S:g} s"
            if reason:
                pytest.skip(f"npm cannot install {', '.join(PACKAGES)}: {reason}")
            (folder / "complete").touch()
    return folder


def splat_transform(readers: Path, *arguments: str | Path) -> None:
    """Run the command splat-transform."""
    program = readers / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    command = ["node", str(program), "--quiet", "--overwrite", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def gltf_issues(readers: Path, file: Path) -> dict:
    """Return what Khronos' validator says of a GLB file: counts by severity, and messages."""
    script = """const bytes = new Uint8Array(require("fs").readFileSync(process.argv[1]));
        require("gltf-validator").validateBytes(bytes).then(r => console.log(JSON.stringify(r.issues)));"""
    arguments = ["node", "-e", script, str(file)]
    done = subprocess.run(arguments, cwd=readers, capture_output=True, text=True, check=True, timeout=60)
    return json.loads(done.stdout)


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def do_GET(self) -> None:
        if (
            self.path == "/favicon.ico"
        ):  # which browsers ask for; its absence would be an error on the console
            self.send_response(204)
            self.end_headers()
        else:
            super().do_GET()

    def log_message(self, *_: object) -> None:
        pass


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """Give the URL under which a folder is served on this machine: modules and workers do not load from files."""
    handler = functools.partial(_Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()
