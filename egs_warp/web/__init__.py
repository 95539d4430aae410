"""Browser page that shows a finished run or a live simulation: its data packets and its server (not part of the paper).

Input: a run folder, or a creature and its solver (``session``). Output: a page at a local address, or one HTML file.
TypeScript sources: ``client/``, which npm builds into ``page.html``, and ``player/``, the player for other pages.
"""
