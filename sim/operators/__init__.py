"""Who drives: routes, pure pursuit along them, and regard for other machines."""
