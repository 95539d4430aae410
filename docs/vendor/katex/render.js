// Formulas between \( \) and \[ \], drawn by KaTeX from this folder; no network.
document$.subscribe(({ body }) => {
  for (const element of body.querySelectorAll(".arithmatex")) {
    const display = element.tagName === "DIV";
    const formula = element.textContent.trim().replace(/^\\[([]/, "").replace(/\\[)\]]$/, "");
    katex.render(formula, element, { displayMode: display, throwOnError: false });
  }
});
