// The player of a shot: two views of one frame side by side, with a timeline.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("overlay-data").textContent);
  const FRAME_MS = 150;
  const views = Object.keys(data.views), last = data.names.length - 1;
  const state = { frame: Math.min(1, last), since: null, first: 0 };
  const place = document.getElementById("player");
  const el = (tag, attributes, ...children) => {
    const node = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    node.append(...children);
    return node;
  };
  const panels = ["beauty", "rejected"].map((wanted, number) => {
    const image = el("img", { alt: "" });
    const caption = el("figcaption", {});
    const chooser = el("select", { autocomplete: "off", "aria-label": "view " + (number + 1) },
      ...views.map((view) => el("option", { value: view }, view)));
    chooser.value = views.includes(wanted) ? wanted : views[Math.min(number, views.length - 1)];
    chooser.addEventListener("change", draw);
    return { image, caption, chooser, node: el("figure", {}, chooser, image, caption) };
  });
  const timeline = el("input", { type: "range", class: "timeline", min: 0, max: last, step: 1, "aria-label": "frame", autocomplete: "off" });
  const play = el("button", { type: "button" });
  const count = el("span", { class: "note count" });
  function draw() {
    for (const { image, caption, chooser } of panels) {
      const picture = data.views[chooser.value][state.frame];
      image.style.visibility = picture ? "visible" : "hidden";
      if (picture) image.src = picture;
      image.alt = `${chooser.value}, ${data.names[state.frame]}`;
      caption.textContent = data.legend[chooser.value] + (picture ? "" : "; not in this frame");
    }
    timeline.value = state.frame;
    count.textContent = `${data.names[state.frame]} (${state.frame + 1} of ${last + 1})`;
    play.textContent = state.since === null ? "▶ play" : "❚❚ pause";
  }
  function show(frame) { state.frame = (frame + last + 1) % (last + 1); draw(); }
  function pause() { clearInterval(state.timer); state.since = null; draw(); }
  function toggle() {
    if (state.since !== null) return pause();
    state.first = state.frame;
    state.since = performance.now();
    state.timer = setInterval(() => show(state.first + Math.floor((performance.now() - state.since) / FRAME_MS)), FRAME_MS / 2);
    draw();
  }
  const step = (by) => { pause(); show(state.frame + by); };
  const acts = { " ": toggle, ",": () => step(-1), ".": () => step(1) };
  play.addEventListener("click", toggle);
  timeline.addEventListener("input", () => { const chosen = Number(timeline.value); pause(); show(chosen); });
  document.addEventListener("keydown", (event) => {
    if (!acts[event.key] || event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|BUTTON)$/.test(event.target.tagName)) return;
    event.preventDefault();
    acts[event.key]();
  });
  place.append(el("div", { class: "bar" }, play, timeline, count),
    el("div", { class: "pair" }, ...panels.map((panel) => panel.node)));
  draw();
})();
