"""Access: certificates, name register, access rules, signatures."""
