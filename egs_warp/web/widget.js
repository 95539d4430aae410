
// Module of the widget of notebooks, after the code of the player (egs_warp.web.notebook.widget_module).

export default {
  render({ model, el }) {
    const player = document.createElement("egs-player");
    for (const name of model.get("plays") ? ["autoplay", "loop", "controls"] : ["autoplay"]) {
      player.setAttribute(name, "");
    }
    player.style.width = "100%";
    const address = URL.createObjectURL(new Blob([model.get("bundle")]));
    player.setAttribute("src", address);
    el.append(player);
    return () => {
      player.remove();
      URL.revokeObjectURL(address);
    };
  },
};
