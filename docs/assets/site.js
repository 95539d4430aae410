// Films of the gallery play while they are seen; where the reader wants no motion, none plays by itself.
document$.subscribe(({ body }) => {
  const films = body.querySelectorAll("video");
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
    for (const film of films) {
      film.autoplay = false;
      film.controls = true;
      film.pause();
    }
    return;
  }
  const seen = new IntersectionObserver((changes) => {
    for (const { target, isIntersecting } of changes) {
      if (isIntersecting) target.play().catch(() => { target.controls = true; });
      else target.pause();
    }
  }, { threshold: 0.3 });
  for (const film of films) seen.observe(film);
});

// A line of code that is wrapped breaks between options and in paths, not within "--object" or a name.
document$.subscribe(({ body }) => {
  for (const code of body.querySelectorAll("pre code:not(:has(span[class])), :not(pre) > code")) {
    for (const text of textsOf(code)) {
      text.replaceWith(...text.data.split(/(--[\w-]+|\/|::)/).flatMap((part) => {
        if (part === "/" || part === "::") return [part, document.createElement("wbr")];
        if (!part.startsWith("--")) return [part];
        const option = document.createElement("span");
        option.className = "option";
        option.textContent = part;
        return [option];
      }));
    }
  }
});

function textsOf(element) {
  const walker = document.createTreeWalker(element, NodeFilter.SHOW_TEXT);
  const texts = [];
  while (walker.nextNode()) texts.push(walker.currentNode);
  return texts;
}

// The theme gives the search no name for screen readers.
document$.subscribe(({ body }) => body.querySelector(".md-search")?.setAttribute("aria-label", "Search"));

// A page of a run takes the place of its film, unless it is asked for in a tab of its own.
document$.subscribe(({ body }) => {
  for (const link of body.querySelectorAll("a.in-3d")) {
    const film = link.closest("figure")?.querySelector("video");
    if (!film) continue;
    link.addEventListener("click", (event) => {
      if (event.ctrlKey || event.metaKey || event.shiftKey) return;
      event.preventDefault();
      const page = document.createElement("iframe");
      page.src = link.href;
      page.title = film.getAttribute("aria-label");
      page.className = "in-3d";
      film.replaceWith(page);
      link.remove();
    });
  }
});
