"""Simulated receivers' ports, read by an agent's driver and gpsd."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

from agents.drivers import Observed
from agents.drivers.line import Line
from agents.drivers.receiver import ReceiverSource
from protocol.errors import ConfigError
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Gps, GpsVelocity
from sim.receivers.ports import Ports, PseudoTerminal
from sim.receivers.receiver import SimulatedReceiver, Wiring
from tests.patience import until
from tests.unit.agents.drivers.frames import TEN

STEP_NS = 200_000_000  # 5 Hz
FIX = SensorConfig("gps-1", "gps", std={"position": 2.0})
MOTION = SensorConfig("doppler-1", "gps_velocity", std={"velocity": 0.1})
WIRING = Wiring("loader-1-gps-1", "nmea", STEP_NS, {"fix": FIX, "velocity": MOTION})


def measured(i: int) -> tuple[Gps, GpsVelocity]:
    """Epoch i of a receiver moving north."""
    at_ns = TEN * 10**9 + i * STEP_NS
    fix = Gps("gps-1", at_ns, 49.01 + i * 4e-6, 8.4, 157.3, 0.25, 0.25, 1.0)
    return fix, GpsVelocity("doppler-1", at_ns, 0.0, 2.2, 0.0025, 0.0025)


def test_a_simulated_port_is_read_from_when_it_is_opened_and_is_gone_with_the_simulator(tmp_path: Path) -> None:
    now_ns, values = 10**12, list[Observed]()
    with closing(Ports(tmp_path, {"loader-1": [WIRING]})) as ports:
        line = Line("nmea", WIRING.feeds)
        source = ReceiverSource(str(tmp_path / WIRING.name), 0, "nmea", line, lambda: now_ns, lambda _: None)
        assert ports.send("loader-1", measured(0)) == ()
        assert source.read(0.0) == (), "what was sent before it was opened is lost"
        for i in (1, 2):
            ports.send("loader-1", measured(i))
            until(lambda: values.extend(v for v in source.read(0.0) or () if v.kind == "gps") or values, "a fix")
        source.close()
        for i in range(3, 300):
            ports.send("loader-1", measured(i))  # no listener, no queue
    assert values[0].utc_ns == TEN * 10**9 + STEP_NS
    assert list(tmp_path.iterdir()) == []


def test_a_port_takes_the_place_of_one_that_a_killed_simulator_left_but_of_no_file(tmp_path: Path) -> None:
    (tmp_path / "gps-1").symlink_to("/dev/pts/no-more")
    with closing(PseudoTerminal(tmp_path / "gps-1")):
        assert os.path.realpath(tmp_path / "gps-1").startswith("/dev/pts/")
    (tmp_path / "gps-1").write_text("a file")
    with pytest.raises(ConfigError, match="no port can be there"):
        PseudoTerminal(tmp_path / "gps-1")


def free_port() -> int:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("gpsd"), reason="gpsd is not installed (Debian's package gpsd)")
def test_gpsd_reports_what_a_simulated_receiver_sends(tmp_path: Path) -> None:
    sent, values, number = 0, dict[int, tuple[float, ...]](), free_port()
    with closing(PseudoTerminal(tmp_path / "gps-1")) as port:
        device = os.path.realpath(tmp_path / "gps-1")
        daemon = subprocess.Popen(["gpsd", "-N", "-n", "-S", str(number), device])
        source = ReceiverSource(f"tcp://127.0.0.1:{number}", 0, "gpsd", Line("gpsd", WIRING.feeds))
        spoken = SimulatedReceiver(WIRING)

        def heard() -> bool:
            nonlocal sent
            port.write(spoken.speak(measured(sent)))
            sent += 1
            values.update((v.utc_ns, v.values) for v in source.read(0.05) or () if v.kind == "gps")
            return len(values) > 5

        try:
            until(heard, "fixes of gpsd")
        finally:
            source.close()
            daemon.terminate()
            daemon.wait()
    for utc_ns, (lat, lon, height_m, *_) in values.items():
        fix, _ = measured((utc_ns - TEN * 10**9) // STEP_NS)
        assert (lat, lon) == pytest.approx((fix.lat_deg, fix.lon_deg), abs=1.1e-7, rel=0)
        assert height_m == pytest.approx(fix.height_m, abs=0.06)
