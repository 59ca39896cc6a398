"""Followers: processes that read the journal of a site and answer queries of its map."""
