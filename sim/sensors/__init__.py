"""What machines' sensors read of a true state: models of their errors, and rigs of them."""
