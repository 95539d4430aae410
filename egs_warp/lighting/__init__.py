"""Light of a capture: the main light is estimated from shadow and shading, and the moving creature is relit by it."""
