"""Reports for people: a web page of accuracy, pictures of a cloud, vector files of objects."""
