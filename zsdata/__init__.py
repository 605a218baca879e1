"""zsdata: single photographs in, an endless, reproducible stream of stereo training pairs out."""
