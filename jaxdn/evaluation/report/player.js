// The player: frames of three labels side by side at 10 frames per second, with their errors beneath.
// player(clip, page, el) -> {node, keys}: the element, and (key) => whether it was a key of the player.
"use strict";
const player = (clip, page, el) => {
  const FRAME_MS = 100;
  const film = clip.film, labels = clip.labels.filter((label) => label in film.pictures);
  const last = film.frames - 1;
  const state = { frame: Math.min(clip.shownFrame, last), since: null, timer: 0 };
  const colors = palette(page.errorColors, page.errorScale);
  const images = new Map(); // address of a frame -> its image, decoded when its label is first shown

  // The colour of each grey value g: the error is (g / 255)^2, as the page's scale paints it.
  function palette(anchors, scale) {
    return Array.from({ length: 256 }, (_, grey) => {
      const at = Math.min((grey / 255) ** 2 / scale, 1) * (anchors.length - 1);
      const low = Math.min(Math.floor(at), anchors.length - 2);
      return anchors[low].map((value, channel) => value + (at - low) * (anchors[low + 1][channel] - value));
    });
  }
  const image = (address) => {
    if (!images.has(address)) {
      const made = new Image();
      made.src = address;
      made.decode().then(() => { if (made.awaited) draw(); }, () => {});
      images.set(address, made);
    }
    return images.get(address);
  };
  const paint = (canvas, address, colored) => {
    const source = image(address);
    if (!source.complete || !source.naturalWidth) { source.awaited = true; return; } // it is drawn when it is there
    Object.assign(canvas, { width: source.naturalWidth, height: source.naturalHeight });
    const context = canvas.getContext("2d", { willReadFrequently: colored });
    context.drawImage(source, 0, 0);
    if (colored) {
      const pixels = context.getImageData(0, 0, canvas.width, canvas.height);
      for (let at = 0; at < pixels.data.length; at += 4) pixels.data.set(colors[pixels.data[at]], at);
      context.putImageData(pixels, 0, 0);
    }
    canvas.dataset.frame = state.frame;
  };

  const panels = [page.noisy[0], page.opens, "reference"].map((wanted, number) => {
    const canvas = el("canvas", { role: "img", title: "click: play or pause" });
    const wrong = el("canvas", { role: "img", title: "click: play or pause" });
    const caption = el("figcaption", {});
    const chooser = el("select", { autocomplete: "off", "aria-label": "film " + (number + 1) },
      ...labels.map((label) => el("option", { value: label }, label)));
    chooser.value = labels.includes(wanted) ? wanted : labels[Math.min(number, labels.length - 1)];
    chooser.addEventListener("change", () => { load(chooser.value); draw(); });
    for (const each of [canvas, wrong]) each.addEventListener("click", () => toggle());
    return { canvas, wrong, caption, chooser, node: el("figure", {}, chooser, canvas, wrong, caption) };
  });
  const load = (label) => [...film.pictures[label], ...(film.errors[label] || [])].forEach(image);

  const playing = () => state.since !== null;
  const count = el("span", { class: "note count", "aria-live": "off" });
  const timeline = el("input", { type: "range", class: "timeline", min: 0, max: last, step: 1, "aria-label": "frame", autocomplete: "off" });
  const button = (key, act) => {
    const node = el("button", { type: "button" });
    node.addEventListener("click", act);
    node.dataset.key = key;
    return node;
  };
  const play = button("Space", () => toggle());
  const back = button(",", () => step(-1)), forth = button(".", () => step(1));
  back.append(el("small", {}, ","), "◂ step");
  forth.append(el("small", {}, "."), "step ▸");

  function draw() {
    for (const { canvas, wrong, caption, chooser } of panels) {
      const label = chooser.value, errors = film.errors[label];
      canvas.setAttribute("aria-label", `${label}, frame ${state.frame}`);
      wrong.setAttribute("aria-label", `error of ${label}, frame ${state.frame}`);
      paint(canvas, film.pictures[label][state.frame], false);
      wrong.style.visibility = errors ? "visible" : "hidden";
      if (errors) paint(wrong, errors[state.frame], true);
      const l1 = errors && clip.curves.l1 && clip.curves.l1[label] && clip.curves.l1[label][state.frame];
      caption.replaceChildren(page.about[label] || "", ...(typeof l1 === "number" ? [el("span", {}, "L1 of this frame " + l1.toPrecision(3))] : []));
    }
    timeline.value = state.frame;
    timeline.setAttribute("aria-valuetext", `frame ${state.frame}`);
    count.textContent = `frame ${state.frame} (0 to ${last}` + (film.frames < film.of ? `, of ${film.of} in the clip)` : ")");
    play.replaceChildren(el("small", {}, "Space"), playing() ? "❚❚ pause" : "▶ play");
    play.setAttribute("aria-pressed", playing());
  }
  function show(frame) {
    state.frame = (frame + film.frames) % film.frames;
    draw();
  }
  function pause() {
    clearInterval(state.timer);
    state.since = null;
    draw();
  }
  function toggle() {
    if (playing()) return pause();
    // The frame follows from the time, so that a busy machine drops frames and does not play slowly.
    const first = state.frame;
    state.since = performance.now();
    state.timer = setInterval(() => {
      if (!node.closest("details").open) return pause();
      const frame = (first + Math.floor((performance.now() - state.since) / FRAME_MS)) % film.frames;
      if (frame !== state.frame) show(frame);
    }, FRAME_MS / 4);
    draw();
  }
  function step(by) {
    pause();
    show(state.frame + by);
  }
  timeline.addEventListener("input", () => {
    const chosen = Number(timeline.value); // read before anything is drawn, which sets it
    pause();
    show(chosen);
  });
  const node = el("div", { class: "player" }, el("h3", {}, "Play: 10 frames per second, and the error of each frame"),
    el("div", { class: "bar" }, play, back, forth, timeline, count), el("div", { class: "films" }, ...panels.map((panel) => panel.node)));
  const keys = (key) => {
    const act = { " ": toggle, ",": () => step(-1), ".": () => step(1) }[key];
    if (act) act();
    return Boolean(act);
  };
  for (const { chooser } of panels) load(chooser.value);
  draw();
  return { node, keys };
};
