(() => {
  "use strict";
  const page = JSON.parse(document.getElementById("page-data").textContent);
  const put = (node, attributes, children) => {
    for (const [key, value] of Object.entries(attributes || {})) if (value !== null && value !== false) node.setAttribute(key, value === true ? "" : value);
    node.append(...children);
    return node;
  };
  const el = (tag, attributes, ...children) => put(document.createElement(tag), attributes, children);
  const svg = (tag, attributes, ...children) => put(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
  const state = { measure: page.measures[0].field, size: page.sizes[0], render: true, clip: Object.keys(page.pictures)[0], chosen: null, far: false, hidden: new Set() };
  const colorOf = (family) => (family === page.renderer ? "cn" : "c" + ((page.families.indexOf(family) + 7) % 8));
  const digits = (value, places) => (value === null || value === undefined ? "–" : Number(value).toFixed(places));
  const ms = (value) => (value >= 100 ? value.toFixed(0) : value >= 10 ? value.toFixed(1) : value.toFixed(2)) + " ms";

  // ---- signs: a variant is a shape, a family a colour -----------------------------------------------------------------
  const SHAPES = ["circle", "square", "triangle", "diamond", "down", "plus", "star", "cross", "bar", "pentagon", "hourglass"];
  const corners = (count, inner, turn) => Array.from({ length: count }, (_, i) => {
    const angle = turn + (2 * Math.PI * i) / count, r = i % 2 ? inner : 1;
    return [Math.cos(angle) * r, Math.sin(angle) * r];
  });
  const OUTLINES = {
    square: [[-0.8, -0.8], [0.8, -0.8], [0.8, 0.8], [-0.8, 0.8]],
    triangle: corners(3, 1, -Math.PI / 2).map(([x, y]) => [1.15 * x, 1.15 * y]),
    down: corners(3, 1, Math.PI / 2).map(([x, y]) => [1.15 * x, 1.15 * y]),
    diamond: [[0, -1.15], [1.15, 0], [0, 1.15], [-1.15, 0]],
    plus: [[-0.35, -1.1], [0.35, -1.1], [0.35, -0.35], [1.1, -0.35], [1.1, 0.35], [0.35, 0.35], [0.35, 1.1], [-0.35, 1.1], [-0.35, 0.35], [-1.1, 0.35], [-1.1, -0.35], [-0.35, -0.35]],
    star: corners(10, 0.5, -Math.PI / 2).map(([x, y]) => [1.2 * x, 1.2 * y]),
    cross: corners(8, 0.4, Math.PI / 4).map(([x, y]) => [1.2 * x, 1.2 * y]),
    pentagon: corners(5, 1, -Math.PI / 2).map(([x, y]) => [1.1 * x, 1.1 * y]),
    hourglass: [[-0.9, -1], [0.9, -1], [-0.9, 1], [0.9, 1]],
    bar: [[-0.3, -1.2], [0.3, -1.2], [0.3, 1.2], [-0.3, 1.2]],
  };
  const sign = (variant, x, y, r, attributes) => {
    const shape = SHAPES[Math.max(0, page.variants.indexOf(variant)) % SHAPES.length];
    if (shape === "circle") return svg("circle", { cx: x, cy: y, r: r, ...attributes });
    return svg("polygon", { points: OUTLINES[shape].map(([a, b]) => `${(x + a * r).toFixed(1)},${(y + b * r).toFixed(1)}`).join(" "), ...attributes });
  };

  // ---- where a point lies ----------------------------------------------------------------------------------------------
  const timeOf = (point) => {
    const alone = point.denoise_ms[state.size];
    if (alone === undefined) return null;
    const rendered = point.render_ms[state.size];
    if (point.method === page.renderer) return rendered === undefined ? null : rendered;
    if (!state.render) return alone;
    return rendered === undefined ? null : alone + rendered;
  };
  const errorOf = (point) => { const value = point.errors[state.measure]; return typeof value === "number" ? value : null; };
  const measure = () => page.measures.find((each) => each.field === state.measure);
  const front = (points) => {
    const sorted = points.filter((p) => p.variant !== page.all && (state.render || p.method !== page.renderer)).sort((a, b) => timeOf(a) - timeOf(b));
    let best = Infinity;
    return sorted.filter((p) => { const loss = -measure().better * errorOf(p); if (loss >= best) return false; best = loss; return true; });
  };

  // ---- the plot --------------------------------------------------------------------------------------------------------
  const W = 1130, H = 560, L = 62, R = 24, T = 14, B = 78;
  const ticks = (low, high) => {
    const step = [1, 2, 5, 10, 20, 50].map((s) => s * 10 ** Math.floor(Math.log10((high - low) / 10))).find((s) => (high - low) / s <= 9);
    const found = [];
    for (let value = Math.ceil(low / step) * step; value <= high; value += step) found.push(value);
    return found;
  };
  function draw() {
    const slowest = Math.max(...page.points.filter((p) => p.method !== page.renderer).map((p) => timeOf(p) || 0));
    // The renderer's curve goes on for two more decades, and would leave the rest a corner.
    const near = (p) => state.far || p.method !== page.renderer || !slowest || timeOf(p) < 4 * slowest;
    const shown = page.points.filter((p) => timeOf(p) !== null && near(p) && !state.hidden.has(p.family) && !state.hidden.has("variant " + p.variant));
    const scored = shown.filter((p) => p.spp !== null && errorOf(p) !== null), bare = shown.filter((p) => p.spp === null);
    const box = document.getElementById("plot");
    if (!scored.length) { box.replaceChildren(el("p", { class: "note" }, "Nothing to draw: every family or variant is hidden, or nothing was timed.")); return; }
    const times = shown.map(timeOf), small = measure().better < 0;
    const low = Math.log10(Math.min(...times)) - 0.06, high = Math.log10(Math.max(...times)) + 0.06;
    const scale = (v) => (small ? Math.log10(Math.max(v, 1e-9)) : v);
    const errors = scored.map((p) => scale(errorOf(p)));
    const gap = 0.05 * (Math.max(...errors) - Math.min(...errors) || 1), bottom = Math.min(...errors) - gap, top = Math.max(...errors) + gap;
    const x = (v) => L + ((Math.log10(v) - low) / (high - low)) * (W - L - R);
    // Better is up, whatever the measure.
    const y = (v) => { const share = (scale(v) - bottom) / (top - bottom); return T + (small ? share : 1 - share) * (H - T - B); };
    const root = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": "error against time per frame" });
    for (let power = Math.floor(low); power <= Math.ceil(high); power++) for (const digit of [1, 2, 5]) {
      const value = digit * 10 ** power;
      if (Math.log10(value) < low || Math.log10(value) > high) continue;
      root.append(svg("line", { class: "grid", x1: x(value), x2: x(value), y1: T, y2: H - B + 26 }), svg("text", { x: x(value), y: H - B + 42, "text-anchor": "middle" }, value >= 1000 ? value / 1000 + " s" : value + " ms"));
    }
    const lines = small ? [0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100].filter((v) => scale(v) > bottom && scale(v) < top) : ticks(bottom, top);
    for (const value of lines) root.append(svg("line", { class: "grid", x1: L, x2: W - R, y1: y(value), y2: y(value) }), svg("text", { x: L - 6, y: y(value) + 4, "text-anchor": "end" }, String(+value.toPrecision(4))));
    root.append(svg("text", { x: (L + W - R) / 2, y: H - 12, "text-anchor": "middle" }, `time per frame of ${state.size}, ${state.render ? "rendering included" : "denoising alone (the bare renderer: rendering)"}`));
    root.append(svg("text", { x: 14, y: (T + H - B) / 2, "text-anchor": "middle", transform: `rotate(-90 14 ${(T + H - B) / 2})` }, measure().label + " (better is up)"));
    const best = front(scored);
    root.append(svg("polyline", { class: "front", points: best.map((p) => `${x(timeOf(p))},${y(errorOf(p))}`).join(" ") }));
    for (const method of new Set(scored.map((p) => p.method))) {
      const own = scored.filter((p) => p.method === method).sort((a, b) => a.spp - b.spp);
      root.append(svg("polyline", { class: "path " + colorOf(own[0].family), points: own.map((p) => `${x(timeOf(p))},${y(errorOf(p))}`).join(" ") }));
    }
    const act = (node, p) => {
      node.addEventListener("pointerenter", () => tell(p));
      node.addEventListener("focus", () => tell(p));
      node.addEventListener("click", () => { state.chosen = p.key; draw(); show(p); });
      node.addEventListener("keydown", (event) => { if (event.key === "Enter") { state.chosen = p.key; draw(); show(p); } });
      return node;
    };
    for (const p of bare) root.append(act(sign(p.variant, x(timeOf(p)), H - B + 14, 6, { class: `mark hollow ${colorOf(p.family)}`, tabindex: 0, "aria-label": p.key }), p));
    const written = [];
    for (const p of scored) {
      const px = x(timeOf(p)), py = y(errorOf(p));
      root.append(act(sign(p.variant, px, py, 5.5, { class: `mark ${colorOf(p.family)}${p.key === state.chosen ? " chosen" : ""}`, tabindex: 0, "aria-label": p.key }), p));
      const text = (p.method === page.renderer ? "" : p.method + ", ") + p.spp + " spp";
      const room = [px - 8 - 5.6 * text.length, px - 8, py - 7];
      if (!best.includes(p) || room[0] < L || written.some((other) => Math.abs(other[2] - room[2]) < 11 && other[0] < room[1] && room[0] < other[1])) continue;
      written.push(room);
      root.append(svg("text", { class: "spp", x: px - 8, y: py - 7, "text-anchor": "end" }, text));
    }
    box.replaceChildren(root);
  }
  function tell(p) {
    const parts = [p.spp === null ? p.method : `${p.method} at ${p.spp} spp`];
    const spread = p.spread[state.size];
    if (p.method === page.renderer) parts.push(`rendering ${ms(p.render_ms[state.size])}`);
    else {
      parts.push(`denoising ${ms(p.denoise_ms[state.size])}` + (spread ? ` (${ms(spread[0])} – ${ms(spread[1])})` : ""));
      if (p.render_ms[state.size] !== undefined) parts.push(`rendering ${ms(p.render_ms[state.size])}` + (p.spp === null ? " at 1 spp" : ""));
      if (p.compile[state.size]) parts.push(`first call ${(p.compile[state.size] / 1000).toFixed(1)} s`);
      if (p.peak[state.size]) parts.push(`peak ${p.peak[state.size].toFixed(0)} MiB`);
    }
    for (const each of p.spp === null ? [] : page.measures) parts.push(`${each.label} ${digits(p.errors[each.field], each.better < 0 ? 4 : 2)}`);
    if (p.equal) parts.push(`bare renderer for this PSNR: ${p.equal}`);
    if (p.spp === null) parts.push("error not measured");
    document.getElementById("hovered").textContent = parts.join("  ·  ");
  }
  function show(p) {
    tell(p);
    const box = document.getElementById("shown"), pictures = page.pictures[state.clip] || {};
    if (!pictures[p.key]) { box.replaceChildren(el("p", { class: "note" }, "There is no picture behind this mark: only its time is known.")); return; }
    const figure = (source, text) => el("figure", {}, el("img", { src: source, alt: text }), el("figcaption", {}, text));
    const clips = el("select", { "aria-label": "clip" }, ...Object.keys(page.pictures).map((clip) => el("option", { value: clip, selected: clip === state.clip }, clip)));
    clips.addEventListener("change", () => { state.clip = clips.value; show(p); });
    box.replaceChildren(
      el("div", { class: "bar" }, el("label", {}, "clip ", clips)),
      el("div", { class: "three" }, figure(pictures[p.key], p.key + " spp"), figure(pictures.reference, "reference"),
        figure(page.wrong[state.clip][p.key], `error, black to white: 0 to ${page.scale} (mean over channels, sRGB)`)));
  }

  // ---- controls --------------------------------------------------------------------------------------------------------
  const choice = (label, entries, key) => {
    const node = el("select", {}, ...entries.map(([value, text]) => el("option", { value }, text)));
    node.addEventListener("change", () => { state[key] = node.value; draw(); });
    return el("label", {}, label, node);
  };
  const render = el("input", { type: "checkbox", checked: true });
  render.addEventListener("change", () => { state.render = render.checked; draw(); });
  const far = el("input", { type: "checkbox" });
  far.addEventListener("change", () => { state.far = far.checked; draw(); });
  const known = page.points.some((p) => Object.keys(p.render_ms).length);
  if (!known) state.render = false;
  document.getElementById("controls").append(
    choice("error ", page.measures.map((each) => [each.field, each.label]), "measure"),
    choice("time for one frame of ", page.sizes.map((size, index) => [size, size + (index ? " (the clips' own)" : "")]), "size"),
    ...(known ? [el("label", {}, render, "rendering included"), el("label", {}, far, "the renderer's whole curve")] : []));
  const legend = (id, entries) => {
    for (const [key, text, node] of entries) {
      const button = el("button", { type: "button", "aria-pressed": "true" }, node, text);
      button.addEventListener("click", () => {
        if (!state.hidden.delete(key)) state.hidden.add(key);
        button.setAttribute("aria-pressed", !state.hidden.has(key));
        draw();
      });
      document.getElementById(id).append(button);
    }
  };
  legend("families", page.families.map((family) => [family, family, el("i", { class: "swatch " + colorOf(family) })]));
  const plain = (variant) => (variant === "plain" ? "plain: float32, XLA, demodulated" : variant);
  legend("variants", page.variants.map((variant) => ["variant " + variant, plain(variant), svg("svg", { viewBox: "-8 -8 16 16", fill: "currentColor" }, sign(variant, 0, 0, 5.5, {}))]));
  draw();
  const first = page.points.find((p) => p.spp === 1 && p.method !== page.renderer) || page.points.find((p) => p.spp !== null);
  if (first) { state.chosen = first.key; draw(); show(first); }
})();
