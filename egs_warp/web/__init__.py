"""The page that shows a run in a browser, or a creature that lives, beside the paper: what it is sent, its server.

In: a run's folder, or a creature and its solver (``session``). Out: a local address or one HTML file. The
page's own sources (TypeScript) lie in ``client/``; npm builds them into ``page.html``.
"""
