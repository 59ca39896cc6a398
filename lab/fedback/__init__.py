"""The map fed back: what machines gain that find their lane on the map that all of them drew, and what may harm."""
