"""What runs on a machine: the steps of the filters, and a whole agent."""
