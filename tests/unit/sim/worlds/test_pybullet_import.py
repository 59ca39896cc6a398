import subprocess
import sys


def test_pybullet_is_imported_without_a_word() -> None:
    code = "import sim.worlds.bullet, sim.pictures.render"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")
