"""Drivers: routes, pure pursuit, giving way to other machines."""
