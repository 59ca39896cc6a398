"""`sitegrid probe`: listen to ports and addresses, and report what is there."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from sitegrid.options.values import positive
from sitegrid.process.lifetime import note, plain, say, tell

HELP = "listen to serial ports and addresses, and say what talks there"
EXTRA = "receivers"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    ports = "serial port, tcp://HOST:PORT, udp://[HOST]:PORT, gpsd, CAN bus, or a file (default: all serial ports)"
    parser.add_argument("ports", nargs="*", metavar="PORT", help=ports)
    parser.add_argument("--seconds", type=positive, default=5.0, help="how long to listen (default %(default)s)")


def run(arguments: Namespace) -> int:
    """Listen and report; 1 if no driver can read anything."""
    from agents.drivers.transports import serial_ports
    from sitegrid.setup.hearing import NO_PORT, block, missing
    from sitegrid.setup.listening import address_of, listen_to

    addresses = [address_of(port) for port in arguments.ports] or serial_ports()
    if addresses and not arguments.json:
        note(f"listening at {', '.join(addresses)}")
    every = listen_to(addresses, arguments.seconds)
    lacks = missing(every)
    if arguments.json:
        say({"ports": plain(every), "missing": lacks})
    else:
        lines = [line for heard in every for line in block(heard)]
        tell(*lines, *lacks.values()) if every else tell(NO_PORT)
    return 0 if any(heard.kind for heard in every) else 1
