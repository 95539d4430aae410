"""The page that shows a run in a browser: what it is sent, the file it is exported to, and its server.

In: a run's folder. Out: a local address or one HTML file. The page's own sources (TypeScript) lie in ``client/``; npm
builds them into ``page.html``.
"""
