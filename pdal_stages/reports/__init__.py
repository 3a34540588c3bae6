"""Pages and pictures for people: the accuracy page, the page about a model, maps of a cloud.

Importing this package is light: drawing libraries are loaded by the modules that need them.
"""
