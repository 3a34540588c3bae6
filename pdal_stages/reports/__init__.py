"""Reports for people: web pages, pictures of a cloud, vector files of objects."""
