"""Contact: surfaces and obstacles, pairs, search, elements, and the watch over what they miss."""
