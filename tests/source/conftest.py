"""Property tests judge results, not the machine's mood."""

from hypothesis import settings

settings.register_profile("source", deadline=None)
settings.load_profile("source")
