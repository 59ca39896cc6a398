"""Who is let in: certificates, the register of names, access rules, signatures."""
