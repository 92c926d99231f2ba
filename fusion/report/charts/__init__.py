"""Interactive charts of the report pages (data level: shown).

A chart is a function that takes the Dataset it shows and returns a `style.Chart`: the Bokeh figure, one sentence that says what is seen in
it, and the columns that a reader may download. `embedding.embed` makes them part of a page that needs no other file and no network.
"""
