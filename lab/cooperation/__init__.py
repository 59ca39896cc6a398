"""What machines gain that draw one map together: real agents and a real map server, on recordings of one site."""
