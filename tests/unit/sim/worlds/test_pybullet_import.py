import subprocess
import sys


def test_pybullet_is_imported_without_a_word() -> None:
    code = "import sim.worlds.bullet, sim.pictures.render"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_errors_are_still_shown_afterwards() -> None:
    code = "import sim.worlds.bullet_client, sys; print('broken', file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert done.stderr == b"broken\n"


def test_a_process_without_standard_error_can_simulate() -> None:
    code = "import os; os.close(2); from sim.worlds.bullet_client import pybullet as p; print(p.getAPIVersion() > 0)"
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=True)
    assert done.stdout == b"True\n"
