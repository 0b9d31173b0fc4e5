"""Settings: validated, each with its unit and a sentence. Flag over file over profile over default."""

from graphnav.config.files import read_settings, settings_from, settings_text
from graphnav.config.settings import PROFILES, Settings

__all__ = ["PROFILES", "Settings", "read_settings", "settings_from", "settings_text"]
