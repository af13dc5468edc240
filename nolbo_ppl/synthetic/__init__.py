"""Generated data: shapes, renderer, scenes, worlds and the data sets written from them."""
