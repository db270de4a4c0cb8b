"""Images on disk and on screen: textures, films, colour management and comparison."""
