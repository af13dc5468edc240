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

  // Maps are moved by dragging and zoomed by buttons, keys, a double click, two fingers, or the wheel with Ctrl.
  const SVG = "http://www.w3.org/2000/svg";
  const roundTicks = (low, high, count) => {
    const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
    const step = power * ([1, 2, 5, 10].find((factor) => factor * power >= raw * (1 - 1e-9)) || 10);
    const ticks = [];
    for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) ticks.push(i * step);
    return { ticks, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
  };
  const make = (tag, attributes, text) => {
    const made = document.createElementNS(SVG, tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    if (text !== undefined) made.textContent = text;
    return made;
  };
  for (const map of all("svg[data-zoom]")) {
    const { x, y, box } = JSON.parse(map.dataset.zoom), [left, top, right, bottom] = box;
    const scene = map.querySelector(".scene"), frame = map.querySelector(".frame");
    const round = all("circle", scene).map((mark) => [mark, Number(mark.getAttribute("r"))]);
    const square = all("rect", scene).map((mark) => [mark, ...["x", "y", "width", "height"].map((name) => Number(mark.getAttribute(name)))]);
    const width = map.viewBox.baseVal.width;
    let k = 1, u = 0, v = 0;
    const draw = () => {
      scene.setAttribute("transform", `translate(${u} ${v}) scale(${k})`);
      for (const [mark, r] of round) mark.setAttribute("r", r / k);
      for (const [mark, a, b, w, h] of square) {
        for (const [name, value] of [["x", a + w / 2 - w / 2 / k], ["y", b + h / 2 - h / 2 / k], ["width", w / k], ["height", h / k]]) mark.setAttribute(name, value);
      }
      const across = (p) => x[0] + ((p - u) / k - left) / (right - left) * (x[1] - x[0]);
      const up = (p) => y[0] + (bottom - (p - v) / k) / (bottom - top) * (y[1] - y[0]);
      for (const old of all("line, text:not(.label)", frame)) old.remove();
      const horizontal = roundTicks(across(left), across(right), Math.max(2, Math.floor((right - left) / 90)));
      for (const value of horizontal.ticks) {
        const p = k * (left + (value - x[0]) / (x[1] - x[0]) * (right - left)) + u;
        frame.append(make("line", { x1: p, x2: p, y1: bottom, y2: top }), make("text", { x: p, y: bottom + 16, "text-anchor": "middle" }, value.toFixed(horizontal.digits)));
      }
      const vertical = roundTicks(up(bottom), up(top), Math.max(2, Math.floor((bottom - top) / 42)));
      for (const value of vertical.ticks) {
        const p = k * (bottom - (value - y[0]) / (y[1] - y[0]) * (bottom - top)) + v;
        frame.append(make("line", { x1: left, x2: right, y1: p, y2: p }), make("text", { x: left - 7, y: p + 3.5, "text-anchor": "end" }, value.toFixed(vertical.digits)));
      }
      map.classList.toggle("moved", k !== 1 || u !== 0 || v !== 0);
    };
    const place = (event) => {
      const seen = map.getBoundingClientRect();
      return [(event.clientX - seen.left) * width / seen.width, (event.clientY - seen.top) * width / seen.width];
    };
    const zoom = (factor, at = [(left + right) / 2, (top + bottom) / 2]) => {
      const next = Math.min(100, Math.max(0.02, k * factor));
      u = at[0] - (at[0] - u) * next / k;
      v = at[1] - (at[1] - v) * next / k;
      k = next;
      draw();
    };
    const move = (du, dv) => { u += du; v += dv; draw(); };
    const home = () => { k = 1; u = v = 0; draw(); };
    const bar = document.createElement("div");
    bar.className = "zoom";
    for (const [sign, name, work] of [["+", "Zoom in", () => zoom(1.6)], ["\u2212", "Zoom out", () => zoom(1 / 1.6)], ["\u2922", "Whole map", home]]) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = sign;
      button.title = `${name} (drag to move, Ctrl and the wheel or two fingers to zoom)`;
      button.setAttribute("aria-label", name);
      button.addEventListener("click", work);
      bar.append(button);
    }
    map.before(bar);
    map.setAttribute("tabindex", "0");
    map.addEventListener("keydown", (event) => {
      const keys = { "+": () => zoom(1.6), "=": () => zoom(1.6), "-": () => zoom(1 / 1.6), "0": home, ArrowLeft: () => move(60, 0), ArrowRight: () => move(-60, 0), ArrowUp: () => move(0, 60), ArrowDown: () => move(0, -60) };
      if (!keys[event.key] || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      keys[event.key]();
    });
    map.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      zoom(Math.exp(-0.002 * event.deltaY), place(event));
    }, { passive: false });
    map.addEventListener("dblclick", (event) => zoom(2, place(event)));
    const down = new Map();
    let dragged = false;
    map.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      if (!down.size) dragged = false;
      down.set(event.pointerId, place(event));
    });
    map.addEventListener("pointermove", (event) => {
      const before = down.get(event.pointerId);
      if (!before) return;
      const now = place(event);
      if (down.size === 2) {
        const other = [...down].find(([id]) => id !== event.pointerId)[1];
        const spread = (point) => Math.max(1, Math.hypot(point[0] - other[0], point[1] - other[1]));
        dragged = true;
        down.set(event.pointerId, now);
        return zoom(spread(now) / spread(before), [(now[0] + other[0]) / 2, (now[1] + other[1]) / 2]);
      }
      if (!dragged && Math.hypot(now[0] - before[0], now[1] - before[1]) < 4) return;
      if (!dragged && map.setPointerCapture && event.isTrusted) map.setPointerCapture(event.pointerId);
      dragged = true;
      down.set(event.pointerId, now);
      move(now[0] - before[0], now[1] - before[1]);
    });
    for (const name of ["pointerup", "pointercancel"]) addEventListener(name, (event) => down.delete(event.pointerId));
    map.addEventListener("click", (event) => { if (dragged) { event.stopPropagation(); dragged = false; } }, true);
  }

  // A landmark of a map shows all its views, or else leads to its card.
  const sheet = document.getElementById("views");
  const show = (card) => {
    const views = card.querySelector(".views");
    if (!views || !sheet || !sheet.showModal) return false;
    const copy = views.cloneNode(true);
    copy.open = true;
    sheet.querySelector(".sheet").replaceChildren(card.querySelector("h3").cloneNode(true), copy);
    sheet.showModal();
    return true;
  };
  document.addEventListener("click", (event) => {
    const owner = event.target.closest("[data-card]");
    const card = owner && document.getElementById("card-" + owner.dataset.card);
    if (!card) return;
    all(".card.lit").forEach((other) => other.classList.remove("lit"));
    card.classList.remove("off");
    card.classList.add("lit");
    if (!show(card)) card.scrollIntoView({ block: "center" });
  });
  if (sheet) sheet.addEventListener("click", (event) => {
    if (event.target === sheet || event.target.closest("[data-close]")) sheet.close();
    if (event.target.closest("[data-to-card]")) all(".card.lit").forEach((card) => card.scrollIntoView({ block: "center" }));
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
