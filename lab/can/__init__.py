"""What torque by a machine's bus costs the map, against torque at the wheels, and whether its litres are right."""
