(() => {
  "use strict";
  const page = JSON.parse(document.getElementById("page-data").textContent);
  const REFERENCE = "reference";
  const views = new Map(); // section of a clip -> what the keys can do there
  let touched = null; // the clip that was last pointed at

  const put = (node, attributes, children) => {
    for (const [key, value] of Object.entries(attributes || {})) {
      if (value === null || value === undefined || value === false) continue;
      node.setAttribute(key, value === true ? "" : value);
    }
    node.append(...(children || []));
    return node;
  };
  const el = (tag, attributes, ...children) => put(document.createElement(tag), attributes, children);
  const svg = (tag, attributes, ...children) => put(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
  const colorOf = (label) => (page.noisy.includes(label) ? "cn" : "c" + (page.methods.indexOf(label) % 8));
  const named = (label) => label + (page.about[label] ? ": " + page.about[label] : "");
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  // ---- pictures -----------------------------------------------------------------------------------------------------
  const place = (node, [x, y, w, h], clip) => {
    node.style.left = (100 * x) / clip.width + "%";
    node.style.top = (100 * y) / clip.height + "%";
    node.style.width = (100 * w) / clip.width + "%";
    node.style.height = (100 * h) / clip.height + "%";
    return node;
  };
  const stage = (clip, kind, attributes) => {
    const node = el("div", { class: "stage " + kind, ...attributes });
    node.style.aspectRatio = clip.width + " / " + clip.height;
    return node;
  };

  function flipView(clip) {
    const state = { label: clip.labels[clip.labels.length - 1], error: false, mask: false };
    const box = stage(clip, "flip", { title: "click: next picture" });
    const pictures = {}, wrong = {};
    for (const label of clip.labels) box.append((pictures[label] = el("img", { src: clip.images[label], alt: label })));
    for (const [label, source] of Object.entries(clip.errors)) {
      box.append((wrong[label] = el("img", { src: source, alt: "error of " + label })));
    }
    const mask = clip.mask ? el("img", { class: "mask", src: clip.mask, alt: "disoccluded pixels" }) : null;
    if (mask) box.append(mask);
    const frame = place(el("div", { class: "frame", title: "the crop below" }), clip.crop, clip);
    const tag = el("div", { class: "tag", "aria-live": "polite" });
    box.append(frame, tag);
    const show = () => {
      for (const label of clip.labels) {
        const error = state.error && label in wrong;
        pictures[label].classList.toggle("on", label === state.label && !error);
        if (wrong[label]) wrong[label].classList.toggle("on", label === state.label && error);
        buttons[label].setAttribute("aria-pressed", label === state.label);
      }
      if (mask) mask.classList.toggle("on", state.mask);
      errorButton.setAttribute("aria-pressed", state.error);
      if (maskButton) maskButton.setAttribute("aria-pressed", state.mask);
      tag.textContent = (state.error && state.label !== REFERENCE ? "error of " : "") + named(state.label);
    };
    const button = (key, text, act) => {
      const node = el("button", { type: "button", "aria-pressed": "false" }, ...(key ? [el("small", {}, key)] : []), text);
      node.addEventListener("click", act);
      return node;
    };
    const buttons = {};
    clip.labels.forEach((label, index) => {
      buttons[label] = button(index < 10 ? String((index + 1) % 10) : "", label, () => set({ label }));
    });
    const set = (change) => { Object.assign(state, change); show(); };
    const errorButton = button("E", "error", () => set({ error: !state.error }));
    const maskButton = mask && button("D", "disoccluded", () => set({ mask: !state.mask }));
    box.addEventListener("click", (event) => {
      const next = clip.labels.indexOf(state.label) + (event.shiftKey ? clip.labels.length - 1 : 1);
      set({ label: clip.labels[next % clip.labels.length] });
    });
    const keys = (key) => {
      if (/^[0-9]$/.test(key)) {
        const label = clip.labels[(Number(key) + 9) % 10];
        if (label) set({ label });
      } else if (key === "e") set({ error: !state.error });
      else if (key === "d" && mask) set({ mask: !state.mask });
      else return false;
      return true;
    };
    set({ label: clip.labels.includes(page.opens) ? page.opens : clip.labels[0] });
    const node = el("div", {}, el("h3", {}, "Flip"), el("div", { class: "bar" }, ...Object.values(buttons)), box,
      el("div", { class: "bar tools" }, errorButton, ...(maskButton ? [maskButton] : [])));
    return { node, keys, box };
  }

  function splitView(clip) {
    const known = (label) => clip.labels.includes(label);
    const right = [page.opens, ...clip.labels].find(known);
    const left = [page.svgf, ...clip.labels].find((label) => known(label) && label !== right) || right;
    const box = stage(clip, "split", { tabindex: "0", role: "slider", "aria-label": "split between two methods",
      "aria-valuemin": "0", "aria-valuemax": "100" });
    const under = el("img", { alt: "" }), over = el("img", { class: "over", alt: "" });
    const tagLeft = el("div", { class: "tag" }), tagRight = el("div", { class: "tag right" });
    box.append(under, over, el("div", { class: "handle" }), tagLeft, tagRight);
    let at = 50;
    const move = (value) => {
      at = clamp(value, 0, 100);
      box.style.setProperty("--at", at + "%");
      box.setAttribute("aria-valuenow", Math.round(at));
    };
    const chooser = (name, chosen, image, tag) => {
      const node = el("select", { autocomplete: "off", "aria-label": name }, ...clip.labels.map((label) => el("option", { value: label }, label)));
      const apply = () => {
        image.src = clip.images[node.value];
        image.alt = tag.textContent = node.value;
        box.setAttribute("aria-valuetext", tagLeft.textContent + " left, " + tagRight.textContent + " right");
      };
      node.value = chosen;
      node.addEventListener("change", apply);
      apply();
      return el("label", {}, name, node);
    };
    const bar = el("div", { class: "bar" }, chooser("left", left, under, tagLeft), chooser("right", right, over, tagRight));
    const follow = (event) => {
      const area = box.getBoundingClientRect();
      move((100 * (event.clientX - area.left)) / area.width);
    };
    box.addEventListener("pointerdown", (event) => { box.setPointerCapture(event.pointerId); follow(event); });
    box.addEventListener("pointermove", (event) => { if (box.hasPointerCapture(event.pointerId)) follow(event); });
    box.addEventListener("keydown", (event) => {
      const step = event.shiftKey ? 10 : 2;
      const to = { ArrowLeft: at - step, ArrowDown: at - step, ArrowRight: at + step, ArrowUp: at + step, PageDown: at - 10,
        PageUp: at + 10, Home: 0, End: 100 }[event.key];
      if (to === undefined) return;
      event.preventDefault();
      move(to);
    });
    move(50);
    return el("div", {}, el("h3", {}, "Split"), bar, box, el("div", { class: "bar tools note" }, "drag, or focus and use the arrow keys"));
  }

  function errorTiles(clip) {
    const tiles = Object.entries(clip.errors).map(([label, source]) => {
      const tile = el("div", { class: "tile" }, place(el("img", { src: source, alt: "error of " + label }), [0, 0, clip.width, clip.height], clip));
      tile.style.aspectRatio = clip.width + " / " + clip.height;
      return el("figure", {}, tile, el("figcaption", {}, named(label), el("span", {}, "L1 " + clip.error[label])));
    });
    const scale = document.querySelector(".scale").cloneNode(true);
    return tiles.length ? el("div", {}, el("h3", {}, "Error of frame " + clip.shownFrame + "\u2003", scale), el("div", { class: "tiles errors" }, ...tiles)) : "";
  }

  function crops(clip) {
    const [x, y, w, h] = clip.crop;
    const tile = (sources, caption, error) => {
      const box = el("div", { class: "tile" });
      box.style.aspectRatio = w + " / " + h;
      for (const [source, kind] of sources) {
        const image = el("img", { src: source, class: kind, alt: caption });
        image.style.cssText = `width:${(100 * clip.width) / w}%;height:${(100 * clip.height) / h}%;left:${(-100 * x) / w}%;top:${(-100 * y) / h}%`;
        box.append(image);
      }
      return el("figure", {}, box, el("figcaption", {}, caption, ...(error ? [el("span", {}, "L1 " + error)] : [])));
    };
    const tiles = clip.labels.map((label) => tile([[clip.images[label], "picture"]], named(label), clip.cropError[label]));
    if (clip.mask) tiles.push(tile([[clip.images[REFERENCE], ""], [clip.mask, "mask"]], "disoccluded in cyan, where L1 is taken"));
    const title = clip.mask ? "Worst disocclusion" : "Largest error (this frame has no disoccluded pixels)";
    return el("div", {}, el("h3", {}, `${title}: frame ${clip.shownFrame}, ${w} × ${h} px at (${x}, ${y})`), el("div", { class: "tiles crops" }, ...tiles));
  }

  // ---- curves -------------------------------------------------------------------------------------------------------
  const short = (value) => (value === 0 ? "0" : Math.abs(value) >= 1e5 || Math.abs(value) < 1e-3 ? value.toExponential(1) : String(Number(value.toPrecision(4))));
  function ticks(low, high, count) {
    const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((factor) => factor * power).find((value) => value >= raw * 0.999);
    const found = [];
    for (let index = Math.ceil(low / step - 1e-9); index * step <= high + step * 1e-9; index++) found.push(index * step);
    return found;
  }

  // series: [{label, color, x, y, hidden, dots}]; options: {title, xLabel, zero, floor, mark}
  function chart(series, options) {
    const holder = el("div", { class: "plot" }), legend = el("div", { class: "legend" });
    const node = el("div", { class: "chart" }, el("h3", {}, options.title), holder, legend);
    const number = (value) => typeof value === "number";
    const usable = series.filter((one) => one.y.some(number));
    if (!usable.length) {
      holder.replaceWith(el("p", { class: "note" }, "No finite values."));
      return node;
    }
    const hidden = new Set(usable.filter((one) => one.hidden).map((one) => one.label));
    if (hidden.size === usable.length) hidden.clear();
    const grid = [...new Set(usable.flatMap((one) => one.x))].sort((a, b) => a - b);
    const values = {};
    const items = usable.map((one) => {
      const value = (values[one.label] = el("span", {}));
      const item = el("button", { type: "button" }, el("i", { class: "swatch " + one.color }), one.label, " ", value);
      item.addEventListener("click", () => {
        hidden.has(one.label) ? hidden.delete(one.label) : hidden.add(one.label);
        draw();
      });
      legend.append(item);
      return item;
    });
    const readout = el("span", { class: "note" });
    legend.append(readout);
    let cursor = -1, width = 0;

    function draw() {
      width = Math.round(holder.clientWidth) || width || 600;
      usable.forEach((one, index) => items[index].setAttribute("aria-pressed", !hidden.has(one.label)));
      const height = width < 500 ? 200 : 240, m = { left: 50, right: 12, top: 10, bottom: 34 };
      const shown = usable.filter((one) => !hidden.has(one.label));
      const all = shown.flatMap((one) => one.y.filter(number));
      let low = Math.min(...all), high = Math.max(...all);
      if (!all.length) [low, high] = [0, 1];
      if (options.zero) low = Math.min(0, low);
      // A floor far above the curves would squeeze them: then the legend tells it and the axis does not show it.
      const floorFits = number(options.floor) && options.floor < high + 0.6 * (high - low) + 1;
      if (floorFits) high = Math.max(high, options.floor);
      if (high - low < 1e-9 * Math.max(1, Math.abs(high))) { high += Math.abs(high) * 0.1 || 1; low -= options.zero ? 0 : Math.abs(low) * 0.1 || 1; }
      high += (high - low) * 0.06;
      if (!options.zero) low -= (high - low) * 0.06;
      const first = grid[0], last = grid.length > 1 ? grid[grid.length - 1] : first + 1;
      const px = (x) => m.left + ((x - first) / (last - first)) * (width - m.left - m.right);
      const py = (y) => height - m.bottom - ((y - low) / (high - low)) * (height - m.top - m.bottom);
      const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, tabindex: "0", role: "img", "aria-label": options.title });
      for (const value of ticks(low, high, 5)) {
        picture.append(svg("line", { class: "grid", x1: m.left, x2: width - m.right, y1: py(value), y2: py(value) }),
          svg("text", { x: m.left - 8, y: py(value) + 4, "text-anchor": "end" }, short(value)));
      }
      for (const value of ticks(first, last, Math.max(3, Math.floor(width / 110)))) {
        picture.append(svg("text", { x: px(value), y: height - m.bottom + 17, "text-anchor": "middle" }, short(value)));
      }
      picture.append(svg("text", { x: width - m.right, y: height - 2, "text-anchor": "end" }, options.xLabel));
      const dash = (kind, x1, x2, y1, y2) => picture.append(svg("line", { class: kind, x1, x2, y1, y2 }));
      if (number(options.mark)) dash("mark", px(options.mark), px(options.mark), m.top, height - m.bottom);
      if (floorFits) dash("floor", m.left, width - m.right, py(options.floor), py(options.floor));
      for (const one of shown) {
        let path = "", broken = true;
        one.y.forEach((y, index) => {
          if (!number(y)) { broken = true; return; }
          const next = one.y[index + 1];
          path += (broken ? "M" : "L") + px(one.x[index]).toFixed(1) + " " + py(y).toFixed(1);
          if (one.dots || (broken && !number(next))) {
            picture.append(svg("circle", { class: "dot " + one.color, cx: px(one.x[index]), cy: py(y), r: one.dots ? 2.5 : 2 }));
          }
          broken = false;
        });
        picture.append(svg("path", { class: "line " + one.color, d: path }));
      }
      const line = svg("line", { class: "cursor", y1: m.top, y2: height - m.bottom, visibility: "hidden" });
      picture.append(line);
      const read = () => {
        const x = grid[cursor];
        line.setAttribute("visibility", cursor < 0 ? "hidden" : "visible");
        if (cursor >= 0) { line.setAttribute("x1", px(x)); line.setAttribute("x2", px(x)); }
        for (const one of usable) {
          const y = cursor < 0 ? undefined : one.y[one.x.indexOf(x)];
          values[one.label].textContent = number(y) ? short(y) : "";
        }
        const floor = number(options.floor) ? `noise floor ${options.floor.toFixed(2)} dB` + (floorFits ? " (dashed)" : " (above this axis)") : "";
        readout.textContent = [cursor < 0 ? "" : `${options.xLabel} ${short(x)}`, floor].filter(Boolean).join(" · ");
      };
      picture.addEventListener("pointermove", (event) => {
        const area = picture.getBoundingClientRect();
        const x = first + (((event.clientX - area.left) * width / area.width - m.left) / (width - m.left - m.right)) * (last - first);
        cursor = grid.reduce((best, value, index) => (Math.abs(value - x) < Math.abs(grid[best] - x) ? index : best), 0);
        read();
      });
      picture.addEventListener("pointerleave", () => { cursor = -1; read(); });
      picture.addEventListener("keydown", (event) => {
        const by = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10 }[event.key];
        if (!by) return;
        event.preventDefault();
        cursor = clamp(cursor < 0 ? 0 : cursor + by, 0, grid.length - 1);
        read();
      });
      read();
      holder.replaceChildren(picture);
    }
    new ResizeObserver(() => { if (Math.round(holder.clientWidth) !== width) draw(); }).observe(holder);
    return node;
  }

  const NAMES = { psnr: "PSNR dB", l1: "L1", disoccluded_l1: "L1 in disoccluded pixels", mse: "MSE" };
  function clipCurves(clip) {
    const metrics = Object.keys(clip.curves);
    if (!metrics.length) return [];
    return metrics.map((metric) => {
      const series = page.methods.filter((label) => label in clip.curves[metric]).map((label) => {
        const y = clip.curves[metric][label];
        return { label, color: colorOf(label), x: y.map((_, index) => index), y, hidden: page.noisy.includes(label) };
      });
      const decibels = metric.endsWith("psnr");
      return chart(series, { title: (NAMES[metric] || metric) + " over consecutive frames", xLabel: "frame", zero: !decibels,
        floor: metric === "psnr" ? clip.floor : null, mark: clip.shownFrame });
    });
  }

  // ---- the page -----------------------------------------------------------------------------------------------------
  function build(section) {
    if (views.has(section) || !section.open) return;
    const clip = JSON.parse(section.querySelector("script").textContent);
    let keys = () => false, box = section;
    if (clip.images) {
      const flip = flipView(clip);
      ({ keys, box } = flip);
      section.querySelector(".views").append(el("div", { class: "pair" }, flip.node, splitView(clip)), crops(clip), errorTiles(clip));
    }
    if (clip.film) {
      const films = player(clip, page, el), rest = keys;
      section.querySelector(".views").prepend(films.node);
      keys = (key) => films.keys(key) || rest(key);
    }
    views.set(section, { keys, box });
    section.querySelector(".curves").append(...clipCurves(clip));
  }
  function current() {
    const focused = document.activeElement && document.activeElement.closest("details.clip");
    const seen = (section) => {
      if (!section || !section.open || !views.has(section)) return false;
      const area = section.getBoundingClientRect();
      return area.bottom > 0 && area.top < innerHeight;
    };
    const middle = (section) => { const area = views.get(section).box.getBoundingClientRect(); return Math.abs((area.top + area.bottom - innerHeight) / 2); };
    const open = [...views.keys()].filter((section) => section.open).sort((a, b) => middle(a) - middle(b));
    return [focused, touched].find(seen) || open[0];
  }
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
    if (event.key === " " && /^(BUTTON|SUMMARY|A)$/.test(event.target.tagName)) return; // it presses them
    const section = current();
    if (section && views.get(section).keys(event.key.toLowerCase())) event.preventDefault();
  });
  for (const section of document.querySelectorAll("details.clip")) {
    section.addEventListener("toggle", () => build(section));
    section.addEventListener("pointerover", () => { touched = section; });
    build(section);
  }
  const reveal = () => {
    const target = /^#clip-\d+$/.test(location.hash) && document.querySelector(location.hash);
    if (target) { target.open = true; build(target); target.scrollIntoView(); }
  };
  addEventListener("hashchange", reveal);
  reveal();
  const metric = document.getElementById("metric");
  const tables = () => {
    for (const table of document.querySelectorAll("#overview [data-metric]")) table.hidden = table.dataset.metric !== metric.value;
  };
  metric.addEventListener("change", tables);
  tables();
  const runs = Object.entries(page.training);
  if (runs.length) {
    const color = (label, index) => (page.methods.includes(label) ? colorOf(label) : "c" + (index % 8));
    document.getElementById("loss").append(chart(runs.map(([label, run], index) => ({ label, color: color(label, index), x: run.step, y: run.loss })),
      { title: "Training loss", xLabel: "step", zero: true }));
    document.getElementById("validation").append(chart(runs.map(([label, run], index) => ({ label, color: color(label, index),
      x: run.validationStep, y: run.validationPsnr, dots: run.validationStep.length < 60 })), { title: "Validation PSNR dB", xLabel: "step" }));
  }
})();
