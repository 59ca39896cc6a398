"""Drivers: routes, pure pursuit along them, and waiting for other machines."""
