"""Settings: validated, each with its unit and a sentence. Flag over file over profile over default."""

from graphnav.config.files import format_settings, parse_settings, read_settings
from graphnav.config.settings import PROFILES, Settings

__all__ = ["PROFILES", "Settings", "format_settings", "parse_settings", "read_settings"]
