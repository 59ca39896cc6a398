"""What a site costs by its number of machines: bytes measured, and sums of measured figures."""
