"""What is known of Mitsuba: LLVM and variant, scenes, views, rays, random numbers, light paths."""
