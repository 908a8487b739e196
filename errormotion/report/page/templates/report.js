// Values under the pointer, zoom, and drawings in space that turn. The page is complete without it.
(() => {
  "use strict";
  const comma = document.documentElement.lang === "de";
  const text = (value, decimals) => {
    const fixed = value.toFixed(Math.min(Math.max(decimals, 0), 9)).replace("-", "\u2212");
    return comma ? fixed.replace(".", ",") : fixed;
  };
  const numbers = (written) => (written || "").trim().split(/[\s,]+/).filter(Boolean).map(Number);
  const tip = document.createElement("div");
  tip.className = "tip";
  tip.hidden = true;
  document.body.append(tip);

  function show(rows, event) {
    tip.replaceChildren(...rows.map(([colour, words]) => {
      const row = document.createElement("div");
      if (colour) {
        const mark = document.createElement("span");
        mark.className = "mark";
        mark.style.background = colour;
        row.append(mark);
      }
      row.append(words);
      return row;
    }));
    tip.hidden = false;
    const wide = tip.offsetWidth, high = tip.offsetHeight;
    const x = event.clientX + 14 + wide > innerWidth ? event.clientX - 14 - wide : event.clientX + 14;
    const y = event.clientY + 14 + high > innerHeight ? event.clientY - 14 - high : event.clientY + 14;
    tip.style.left = `${Math.max(x, 0)}px`;
    tip.style.top = `${Math.max(y, 0)}px`;
  }
  const hide = () => { tip.hidden = true; };

  // Graphs

  const PAIRS = /(-?\d*\.?\d+(?:e-?\d+)?)[\s,]+(-?\d*\.?\d+(?:e-?\d+)?)/g;

  class Axis {
    constructor(range, kind, low, high) {
      [this.first, this.last] = numbers(range);
      Object.assign(this, { kind, low, high });
      if (kind === "log") [this.first, this.last] = [Math.log10(this.first), Math.log10(this.last)];
    }
    value(place) {
      const value = this.first + (place - this.low) / (this.high - this.low) * (this.last - this.first);
      return this.kind === "log" ? 10 ** value : value;
    }
    place(value) {
      const on = this.kind === "log" ? Math.log10(value) : value;
      return this.low + (on - this.first) / (this.last - this.first) * (this.high - this.low);
    }
    words(place, [low, high]) {
      const value = this.value(place);
      if (this.kind === "date") return new Date(864e5 * value).toISOString().slice(0, 16).replace("T", " ");
      const step = Math.abs(this.value(high) - this.value(low)) / 1000;
      return text(value, Math.ceil(-Math.log10(this.kind === "log" ? Math.abs(value) / 1000 : step)));
    }
  }

  class Panel {
    constructor(group) {
      const [x, y, wide, high] = numbers(group.dataset.box);
      Object.assign(this, { group, svg: group.ownerSVGElement, x, y, wide, high });
      this.across = new Axis(group.dataset.x, group.dataset.xKind, x, x + wide);
      this.up = new Axis(group.dataset.y, group.dataset.yKind, y + high, y);
      this.curves = [...group.querySelectorAll("[data-curve]")].map((g) => this.curve(g));
      this.view = [x, x + wide, y, y + high];
    }
    curve(g) {
      const path = g.querySelector(":scope > path[d]");
      const points = path
        ? [...path.getAttribute("d").matchAll(PAIRS)].map((pair) => [Number(pair[1]), Number(pair[2])])
        : [...g.querySelectorAll("use")].map((use) => [Number(use.getAttribute("x")), Number(use.getAttribute("y"))]);
      const expanded = numbers(g.dataset.u);
      return { name: g.dataset.name || "", colour: g.dataset.colour, unit: g.dataset.unit || "", points,
               expanded: expanded.length === points.length ? expanded : null };
    }
    holds(x, y) {
      return x >= this.x && x <= this.x + this.wide && y >= this.y && y <= this.y + this.high;
    }
    original(x, y) {
      const [left, right, top, bottom] = this.view;
      return [left + (x - this.x) / this.wide * (right - left), top + (y - this.y) / this.high * (bottom - top)];
    }
    shown([x, y]) {
      const [left, right, top, bottom] = this.view;
      return [this.x + (x - left) / (right - left) * this.wide, this.y + (y - top) / (bottom - top) * this.high];
    }
    rows(x, y) {
      const [px, py] = this.original(x, y);
      const sx = (this.view[1] - this.view[0]) / this.wide, sy = (this.view[3] - this.view[2]) / this.high;
      const found = [];
      for (const curve of this.curves) {
        let best = -1, least = Infinity;
        curve.points.forEach(([qx, qy], i) => {
          const far = Math.hypot((qx - px) / sx, 0.15 * (qy - py) / sy);
          if (far < least) [best, least] = [i, far];
        });
        if (best < 0 || least > 40) continue;
        const [qx, qy] = curve.points[best];
        found.push({ curve, best, qx, qy, far: Math.hypot((qx - px) / sx, (qy - py) / sy) });
      }
      return found.sort((a, b) => a.far - b.far).slice(0, 8);
    }
    tell(found) {
      const [left, right, top, bottom] = this.view;
      const { xName, xUnit } = this.group.dataset;
      const at = `${xName} ${this.across.words(found[0].qx, [left, right])} ${xUnit}`.trim();
      const lines = this.across.kind === "fixed" ? [] : [["", at]];
      for (const { curve, best, qy } of found) {
        const value = this.up.words(qy, [bottom, top]);
        const U = curve.expanded && Number.isFinite(curve.expanded[best]) && curve.expanded[best] > 0
          ? ` \u00b1 ${text(curve.expanded[best], Math.max(1 - Math.floor(Math.log10(curve.expanded[best])), 0))}` : "";
        lines.push([curve.colour, ` ${curve.name ? `${curve.name}: ` : ""}${value}${U} ${curve.unit}`]);
      }
      return lines;
    }
  }

  function clean(low, high) {
    const rough = (high - low) / 7, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].find((k) => k * power >= rough) * power, found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
    return [found, Math.max(-Math.floor(Math.log10(step) + 1e-9), 0)];
  }

  class Graph {
    constructor(svg) {
      this.svg = svg;
      this.make = (name, attributes) => {
        const made = document.createElementNS(svg.namespaceURI, name);
        for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
        return made;
      };
      this.panels = [...svg.querySelectorAll("g.panel")].map((group) => new Panel(group));
      this.cursor = this.make("g", { "pointer-events": "none" });
      this.frame = this.make("rect", { fill: "#0072B2", "fill-opacity": 0.12, stroke: "#0072B2", "stroke-width": 0.6 });
      svg.append(this.cursor);
      svg.style.cursor = "crosshair";
      svg.addEventListener("pointermove", (event) => this.move(event));
      svg.addEventListener("pointerleave", () => { hide(); this.cursor.replaceChildren(); });
      svg.addEventListener("pointerdown", (event) => this.press(event));
      svg.addEventListener("pointerup", (event) => this.release(event));
      svg.addEventListener("dblclick", () => this.reset());
      const figure = svg.closest("figure");
      figure.tabIndex = 0;
      figure.addEventListener("keydown", (event) => this.key(event));
      figure.addEventListener("blur", hide);
      [this.row, this.share] = [0, 0.5];
    }
    key(event) {
      const along = { ArrowLeft: -0.01, ArrowRight: 0.01 }[event.key], down = { ArrowUp: -1, ArrowDown: 1 }[event.key];
      if (event.key === "Escape") this.reset();
      if (!along && !down) return;
      event.preventDefault();
      this.share = Math.min(Math.max(this.share + (along || 0), 0), 1);
      this.row = Math.min(Math.max(this.row + (down || 0), 0), this.panels.length - 1);
      const { x, y, wide, high } = this.panels[this.row];
      const at = new DOMPoint(x + this.share * wide, y + high / 2).matrixTransform(this.svg.getScreenCTM());
      this.move({ clientX: at.x, clientY: at.y });
    }
    at(event) {
      const place = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
      return [place.x, place.y];
    }
    move(event) {
      const [x, y] = this.at(event);
      if (this.start) {
        const [panel, x0, y0] = this.start;
        const a = Math.min(Math.max(x, panel.x), panel.x + panel.wide);
        const b = Math.min(Math.max(y, panel.y), panel.y + panel.high);
        this.box = [Math.min(a, x0), Math.max(a, x0), Math.min(b, y0), Math.max(b, y0)];
        if (this.box[3] - this.box[2] < 8) this.box.splice(2, 2, panel.y, panel.y + panel.high);
        const [left, right, top, bottom] = this.box;
        for (const [key, value] of Object.entries({ x: left, y: top, width: right - left, height: bottom - top })) {
          this.frame.setAttribute(key, value);
        }
        this.cursor.replaceChildren(this.frame);
        hide();
        return;
      }
      const panel = this.panels.find((each) => each.holds(x, y));
      const found = panel ? panel.rows(x, y) : [];
      if (!found.length) {
        hide();
        this.cursor.replaceChildren();
        return;
      }
      const dots = found.map(({ curve, qx, qy }) => [curve, ...panel.shown([qx, qy])])
        .filter(([, cx, cy]) => panel.holds(cx, cy));
      this.cursor.replaceChildren(...dots.map(([curve, cx, cy]) =>
        this.make("circle", { cx, cy, r: 2.6, fill: "none", stroke: curve.colour, "stroke-width": 1.2 })));
      show(panel.tell(found), event);
    }
    press(event) {
      const [x, y] = this.at(event);
      const panel = this.panels.find((each) => each.holds(x, y) && each.group.hasAttribute("data-zoom"));
      if (!panel || event.button !== 0 || event.pointerType === "touch") return;
      event.preventDefault();
      this.svg.setPointerCapture(event.pointerId);
      this.start = [panel, x, y];
      this.box = null;
    }
    release() {
      const start = this.start, box = this.box;
      this.start = this.box = null;
      this.cursor.replaceChildren();
      if (!start || !box || box[1] - box[0] < 5) return;
      const [panel] = start;
      const [left, top] = panel.original(box[0], box[2]), [right, bottom] = panel.original(box[1], box[3]);
      for (const each of this.panels) {
        const along = each.x === panel.x && each.wide === panel.wide && each.group.dataset.x === panel.group.dataset.x;
        if (each === panel) each.view = [left, right, top, bottom];
        else if (along) each.view.splice(0, 2, left, right);
        else continue;
        this.draw(each);
      }
    }
    reset() {
      for (const panel of this.panels) {
        panel.view = [panel.x, panel.x + panel.wide, panel.y, panel.y + panel.high];
        this.draw(panel);
      }
    }
    draw(panel) {
      const { group } = panel, round = (number) => Number(number.toFixed(2));
      const whole = panel.view[0] === panel.x && panel.view[1] === panel.x + panel.wide
        && panel.view[2] === panel.y && panel.view[3] === panel.y + panel.high;
      for (const part of group.querySelectorAll("[clip-path]")) {
        const kept = part.closest(".tick") ? [] : part.matches("path") ? [part] : [...part.querySelectorAll("path[d],use")];
        for (const each of kept) {
          if (each.hasAttribute("d")) {
            each.dataset.d ??= each.getAttribute("d");
            each.setAttribute("d", whole ? each.dataset.d : each.dataset.d.replace(PAIRS, (_, x, y) =>
              panel.shown([Number(x), Number(y)]).map(round).join(" ")));
          } else {
            each.dataset.at ??= `${each.getAttribute("x")} ${each.getAttribute("y")}`;
            const [x, y] = whole ? numbers(each.dataset.at) : panel.shown(numbers(each.dataset.at)).map(round);
            each.setAttribute("x", x);
            each.setAttribute("y", y);
          }
        }
      }
      const gone = [".place", panel.across.kind === "linear" ? ".tick.x" : "", panel.up.kind === "linear" ? ".tick.y" : ""];
      for (const part of group.querySelectorAll(gone.filter(Boolean).join())) part.style.display = whole ? "" : "none";
      if (panel.ticks) panel.ticks.remove();
      if (!whole) group.append(panel.ticks = this.ticks(panel));
    }
    ticks(panel) {
      const made = this.make("g", { "font-size": 7.5, fill: "#222222", "stroke-width": 0.5 });
      const [left, right, top, bottom] = panel.view;
      const line = (x1, y1, x2, y2) => made.append(this.make("line", { x1, y1, x2, y2, stroke: "#888888", "stroke-opacity": 0.25 }));
      const write = (words, attributes) => {
        const label = this.make("text", attributes);
        label.textContent = words;
        made.append(label);
      };
      if (panel.across.kind === "linear") {
        const [values, decimals] = clean(panel.across.value(left), panel.across.value(right));
        for (const value of values) {
          const [x] = panel.shown([panel.across.place(value), 0]);
          line(x, panel.y, x, panel.y + panel.high);
          if (panel.group.dataset.xTicks) {
            write(text(value, decimals), { x, y: panel.y + panel.high + 11, "text-anchor": "middle" });
          }
        }
      }
      if (panel.up.kind === "linear") {
        const [values, decimals] = clean(panel.up.value(bottom), panel.up.value(top));
        for (const value of values) {
          const [, y] = panel.shown([0, panel.up.place(value)]);
          line(panel.x, y, panel.x + panel.wide, y);
          write(text(value, decimals), { x: panel.x - 5, y: y + 2.7, "text-anchor": "end" });
        }
      }
      return made;
    }
  }

  // Drawings in space

  const HOME = [Math.PI / 6, (24 * Math.PI) / 180];

  class Space {
    constructor(holder) {
      this.scene = JSON.parse(holder.dataset.scene);
      this.canvas = document.createElement("canvas");
      this.canvas.tabIndex = 0;
      this.canvas.setAttribute("role", "img");
      this.canvas.setAttribute("aria-label", holder.closest("figure").getAttribute("aria-label"));
      const still = document.createElement("div");
      still.className = "still";
      still.append(...holder.childNodes);
      holder.append(this.canvas, still);
      this.reset();
      this.canvas.addEventListener("pointerdown", (event) => {
        this.held = [event.clientX, event.clientY];
        this.canvas.setPointerCapture(event.pointerId);
      });
      this.canvas.addEventListener("pointermove", (event) => this.held ? this.drag(event) : this.point(event));
      this.canvas.addEventListener("pointerup", () => { this.held = null; });
      this.canvas.addEventListener("pointerleave", hide);
      this.canvas.addEventListener("dblclick", () => this.reset());
      this.canvas.addEventListener("wheel", (event) => {
        if (document.activeElement !== this.canvas && !event.ctrlKey) return;
        event.preventDefault();
        this.size = Math.min(Math.max(this.size * 1.0015 ** -event.deltaY, 0.3), 40);
        this.draw();
      }, { passive: false });
      this.canvas.addEventListener("keydown", (event) => this.key(event));
      new ResizeObserver(() => this.draw()).observe(this.canvas);
    }
    reset() {
      [this.azimuth, this.elevation] = HOME;
      this.size = 1;
      this.shift = [0, 0];
      this.draw();
    }
    drag(event) {
      const dx = event.clientX - this.held[0], dy = event.clientY - this.held[1];
      this.held = [event.clientX, event.clientY];
      if (event.shiftKey) this.shift = [this.shift[0] + dx, this.shift[1] + dy];
      else this.turn(-dx / 150, dy / 150);
      this.draw();
    }
    turn(across, up) {
      this.azimuth += across;
      this.elevation = Math.min(Math.max(this.elevation + up, -Math.PI / 2), Math.PI / 2);
    }
    key(event) {
      const steps = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (steps) this.turn(...steps);
      else if (event.key === "+") this.size *= 1.2;
      else if (event.key === "-") this.size /= 1.2;
      else if (event.key === "Escape" || event.key === "Home") return this.reset();
      else return undefined;
      event.preventDefault();
      return this.draw();
    }
    camera() {
      const [a, e] = [this.azimuth, this.elevation];
      const right = [Math.cos(a), Math.sin(a), 0];
      const up = [-right[1] * Math.sin(e), right[0] * Math.sin(e), Math.cos(e)];
      return [right, up];
    }
    draw() {
      const { canvas, scene } = this, wide = canvas.clientWidth, high = canvas.clientHeight;
      if (!wide || !high) return;
      const dense = window.devicePixelRatio || 1;
      canvas.width = wide * dense;
      canvas.height = high * dense;
      const pen = canvas.getContext("2d");
      pen.scale(dense, dense);
      const [right, up] = this.camera();
      const dot = (a, p) => a[0] * (p[0] - scene.centre[0]) + a[1] * (p[1] - scene.centre[1]) + a[2] * (p[2] - scene.centre[2]);
      const scale = this.size * Math.min(wide, high) * 0.48 / scene.radius;
      const flat = (p) => [wide / 2 + this.shift[0] + scale * dot(right, p), high / 2 + this.shift[1] - scale * dot(up, p)];
      this.spots = [];
      for (const part of scene.parts) {
        pen.strokeStyle = pen.fillStyle = part.colour;
        pen.globalAlpha = 1;
        if (part.kind === "lines") this.lines(pen, part, flat);
        else if (part.kind === "dots") this.dots(pen, part, flat);
        else this.ellipses(pen, part, flat, right, up, scale);
      }
      this.triad(pen, right, up, high);
    }
    lines(pen, part, flat) {
      pen.lineWidth = part.width * 1.3;
      pen.setLineDash(part.dash ? numbers(part.dash) : []);
      pen.beginPath();
      for (const [a, b] of part.ends) {
        const [x0, y0] = flat(a), [x1, y1] = flat(b), far = Math.hypot(x1 - x0, y1 - y0);
        pen.moveTo(x0, y0);
        pen.lineTo(x1, y1);
        if (!part.head || far < 1) continue;
        const u = [(x1 - x0) / far, (y1 - y0) / far], h = 1.4 * part.head, s = 0.38 * h;
        pen.moveTo(x1 - h * u[0] + s * u[1], y1 - h * u[1] - s * u[0]);
        pen.lineTo(x1, y1);
        pen.lineTo(x1 - h * u[0] - s * u[1], y1 - h * u[1] + s * u[0]);
      }
      pen.stroke();
      pen.setLineDash([]);
    }
    dots(pen, part, flat) {
      pen.font = "bold 11px Arial, sans-serif";
      part.places.forEach((place, i) => {
        const [x, y] = flat(place);
        pen.beginPath();
        pen.arc(x, y, 1.3 * part.radius, 0, 2 * Math.PI);
        pen.fill();
        const name = (part.names || [])[i] || "", note = (part.notes || [])[i] || "";
        if (name) pen.fillText(name, x + 1.3 * part.radius + 3, y - 4);
        this.spots.push([x, y, place, part.colour, note || name]);
      });
    }
    ellipses(pen, part, flat, right, up, scale) {
      const form = (S, a, b) => a.reduce((sum, ai, i) => sum + b.reduce((inner, bj, j) => inner + ai * S[i][j] * bj, 0), 0);
      part.places.forEach((place, i) => {
        const S = part.shapes[i], a = form(S, right, right), b = form(S, right, up), c = form(S, up, up);
        const middle = (a + c) / 2, reach = Math.hypot((a - c) / 2, b), turn = 0.5 * Math.atan2(2 * b, a - c);
        const [x, y] = flat(place);
        pen.beginPath();
        pen.ellipse(x, y, scale * Math.sqrt(middle + reach), scale * Math.sqrt(Math.max(middle - reach, 0)), -turn, 0, 2 * Math.PI);
        pen.globalAlpha = 0.25;
        pen.fill();
        pen.globalAlpha = 1;
        pen.lineWidth = 0.8;
        pen.stroke();
      });
    }
    triad(pen, right, up, high) {
      pen.strokeStyle = pen.fillStyle = "#222222";
      pen.globalAlpha = 1;
      pen.lineWidth = 1;
      pen.font = "11px Arial, sans-serif";
      pen.textAlign = "center";
      ["X", "Y", "Z"].forEach((name, k) => {
        const dx = 26 * right[k], dy = -26 * up[k];
        if (Math.hypot(dx, dy) < 4) return;
        pen.beginPath();
        pen.moveTo(40, high - 40);
        pen.lineTo(40 + dx, high - 40 + dy);
        pen.stroke();
        pen.fillText(name, 40 + 1.35 * dx, high - 36 + 1.35 * dy);
      });
      pen.textAlign = "start";
    }
    point(event) {
      const box = this.canvas.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
      let best = null, least = 9;
      for (const spot of this.spots || []) {
        const far = Math.hypot(spot[0] - x, spot[1] - y);
        if (far < least) [best, least] = [spot, far];
      }
      if (!best) return hide();
      const where = best[2].map((each, k) => `${"XYZ"[k]} ${text(1e3 * each, 1)}`).join("  ");
      return show([["", `${where} mm`], ...(best[4] ? best[4].split("\n").map((line, k) => [k ? "" : best[3], ` ${line}`]) : [])], event);
    }
  }

  for (const svg of document.querySelectorAll("figure > svg")) if (svg.querySelector("g.panel")) new Graph(svg);
  for (const holder of document.querySelectorAll("[data-scene]")) new Space(holder);
  for (const hint of document.querySelectorAll(".hint")) hint.hidden = false;
})();
