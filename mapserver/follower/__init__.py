"""Followers: processes that read a site's journal and answer map queries."""
