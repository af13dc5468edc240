"use strict";
(() => {
  const root = document.documentElement;
  const all = (selector, inside = document) => [...inside.querySelectorAll(selector)];

  // What is pointed at tells about itself; texts are set as text, never as markup.
  const tip = document.getElementById("tip");
  const tell = (text, event) => {
    tip.hidden = !text;
    if (!text) return;
    tip.textContent = text;
    const box = tip.getBoundingClientRect();
    tip.style.left = Math.max(4, Math.min(event.clientX + 14, innerWidth - box.width - 8)) + "px";
    tip.style.top = (event.clientY + box.height + 24 > innerHeight ? event.clientY - box.height - 12 : event.clientY + 16) + "px";
  };
  document.addEventListener("pointermove", (event) => {
    if (event.target.closest(".heat")) return;
    const owner = event.target.closest("[data-tip]");
    tell(owner && owner.dataset.tip, event);
  });
  document.addEventListener("pointerleave", () => tell("", null));
  addEventListener("scroll", () => tell("", null), { passive: true });

  // Layers.
  for (const button of all("[data-toggle]")) {
    button.addEventListener("click", () => {
      const shown = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", String(shown));
      for (const layer of all(`[data-layer="${button.dataset.toggle}"]`, button.closest("figure"))) layer.classList.toggle("off", !shown);
    });
  }

  // A landmark of a map leads to its card.
  document.addEventListener("click", (event) => {
    const owner = event.target.closest("[data-card]");
    const card = owner && document.getElementById("card-" + owner.dataset.card);
    if (!card) return;
    all(".card.lit").forEach((other) => other.classList.remove("lit"));
    card.classList.remove("off");
    card.classList.add("lit");
    card.scrollIntoView({ block: "center" });
  });

  // Cards are sorted and filtered.
  const sorts = { detections: -1, existence: -1, first: 1, spread: -1 };
  for (const select of all("[data-sort]")) {
    select.addEventListener("change", () => {
      const key = select.value, cards = all(".card");
      cards.sort((a, b) => sorts[key] * (Number(a.dataset[key]) - Number(b.dataset[key])));
      for (const card of cards) card.parentNode.append(card);
    });
  }
  for (const select of all("[data-filter]")) {
    select.addEventListener("change", () => {
      for (const card of all(".card")) card.classList.toggle("off", select.value !== "all" && card.dataset.category !== select.value);
    });
  }

  // EM under the slider.
  for (const figure of all('[data-figure="em"]')) {
    const part = (name) => figure.querySelector(`[data-em="${name}"]`);
    const data = JSON.parse(part("data").textContent), slider = part("slider"), play = part("play");
    const show = () => {
      const now = data[Number(slider.value)];
      part("way").setAttribute("points", now.way);
      part("dots").setAttribute("d", now.dots);
      part("say").textContent = now.say;
      for (const mark of all("[data-step]", figure)) mark.classList.toggle("now", mark.dataset.step === slider.value);
    };
    let timer = null;
    const stop = () => { clearInterval(timer); timer = null; play.textContent = "Play"; };
    slider.addEventListener("input", () => { stop(); show(); });
    play.addEventListener("click", () => {
      if (timer !== null) return stop();
      if (Number(slider.value) === data.length - 1) slider.value = "0";
      play.textContent = "Stop";
      show();
      timer = setInterval(() => {
        slider.value = String(Number(slider.value) + 1);
        show();
        if (Number(slider.value) >= data.length - 1) stop();
      }, 700);
    });
    for (const mark of all("[data-step]", figure)) mark.addEventListener("click", () => { stop(); slider.value = mark.dataset.step; show(); });
    show();
  }

  // The heat map's weights are the opacities of its pixels.
  for (const image of all(".heat")) {
    const rows = JSON.parse(image.dataset.rows), columns = JSON.parse(image.dataset.columns);
    let pixels = null;
    const read = () => {
      const canvas = document.createElement("canvas");
      canvas.width = image.naturalWidth;
      canvas.height = image.naturalHeight;
      const context = canvas.getContext("2d", { willReadFrequently: true });
      context.drawImage(image, 0, 0);
      pixels = context.getImageData(0, 0, canvas.width, canvas.height).data;
    };
    image.addEventListener("pointermove", (event) => {
      if (!pixels) read();
      const box = image.getBoundingClientRect();
      const clamp = (value, size) => Math.max(0, Math.min(size - 1, Math.floor(value * size)));
      const column = clamp((event.clientX - box.left) / box.width, image.naturalWidth);
      const row = clamp((event.clientY - box.top) / box.height, image.naturalHeight);
      const opacity = pixels[4 * (row * image.naturalWidth + column) + 3] / 255;
      const frame = columns.frame ? `, frame ${columns.frame[column]}` : "";
      tell(`${rows[row]}\ndetection ${columns.first[column]}${frame}\nweight ${(opacity * opacity).toFixed(2)}`, event);
    });
    image.addEventListener("pointerleave", () => tell("", null));
  }

  for (const button of all("[data-theme-switch]")) {
    button.addEventListener("click", () => {
      const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
      root.dataset.theme = dark ? "light" : "dark";
    });
  }
  root.dataset.ready = "yes";
})();
