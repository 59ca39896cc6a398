"""A site's file (config/site.toml)."""

from pathlib import Path

from protocol.config import from_table
from protocol.files import load_toml
from protocol.site.site_config import SiteConfig


def load_site(path: Path) -> SiteConfig:
    """Read `site.toml`, or [site] of a log's manifest."""
    table = load_toml(path)
    if isinstance(table.get("site"), dict):
        return from_table(SiteConfig, table["site"], f"{path} [site]")
    return from_table(SiteConfig, table, str(path))
