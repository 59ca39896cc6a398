"""What is simulated: scenario files, their tables, and the ground that they describe."""
