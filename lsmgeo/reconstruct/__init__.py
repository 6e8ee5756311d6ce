"""From posed images to depth maps, points, a mesh and an interactive page: the methods, and the result files.

A method is a function ``*_results(scene, view, title, **options)`` that returns `Results`: its arguments are the posed
images, the view to start from (None for the default), the title of the page, and the options of ``lsmgeo reconstruct``.
"""
