// An interactive figure from one block of JSON: sliders, the correlation matrix, and two charts along the slider moved last.
// A study is looked up in its grid; a coupling is computed, because a measurement of a parameter changes it by a formula.
(() => {
  "use strict";
  const root = document.currentScript.closest(".explorer"), find = (of) => root.querySelector(of);
  const data = JSON.parse(find("script[type='application/json']").textContent);
  const { names, target } = data, p = data.parameters.length, q = names.length, study = "places" in data;
  const parameters = data.parameters.map(([name, unit, scale]) => ({ name, unit, scale }));
  const errors = study ? ["frame-dependent rest", "common rotation", "centroid noise (NEA)"] : names.slice(p);
  const headline = study ? "Attitude error across the boresight, 1 σ" : "Common rotation, 1 σ";

  const make = (tag, parent, attributes = {}, text) => {
    const svg = parent.closest("svg") || tag === "svg";
    const node = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    if (text !== undefined) node.textContent = text;
    parent.append(node);
    return node;
  };
  const known = (x) => x !== null && Number.isFinite(x);
  const number = (x, digits = 3) => {
    if (!known(x)) return "–";
    const size = Math.abs(x), plain = size === 0 || (size >= 1e-4 && size < 1e6);
    const text = !plain ? x.toExponential(digits - 1).replace("e", " × 10^").replace("^+", "^")
      : size >= 10 ** digits ? Math.round(x).toLocaleString("en").replaceAll(",", "\u202f") : String(Number(x.toPrecision(digits)));
    return text.replaceAll("-", "−");
  };
  const correlation = (r) => {
    if (!known(r)) return "";
    const size = Math.min(Math.abs(r), 0.9999), text = size.toFixed(size >= 0.999 ? 4 : size >= 0.99 ? 3 : 2);
    return (r < 0 && Number(text) ? "−" : "") + text;
  };
  const unit = (of) => of ? ` ${of}` : "";

  // A coupling is swept over measurements from elsewhere, by their sigma in sigmas of the calibration.
  const shares = [null, 3, 1, 0.3, 0.1, 0.03, 0.01];
  const swept = data.axes?.map((axis) => {
    const [, name, of = ""] = axis.label.match(/^(.*?)(?: \[(.*)\])?$/);
    return { ...axis, name, words: axis.values.map((value) => value + (of === "°" ? of : unit(of))) };
  });
  const axes = swept ?? parameters.map((one, i) => ({
    name: `${one.name} measured elsewhere`, label: `σ of another measurement of ${one.name}`, start: 0,
    values: shares.map((share) => share ? `${share} σ` : "none"),
    words: shares.map((share) => share ? `± ${number(share * data.sigma[i] / one.scale)}${unit(one.unit)}` : "not measured"),
  }));
  const at = axes.map((axis) => axis.start);

  // Numbers at a place: correlations (p × q), sigmas of parameters, the same if all others were known, attitude errors.
  const lookedUp = (place) => {
    const row = data.places[place.reduce((flat, i, axis) => flat * axes[axis].values.length + i, 0)];
    if (!row.some(known)) return null;
    const scaled = (from) => parameters.map((one, i) => known(row[from + i]) ? row[from + i] / one.scale : null);
    return { r: row.slice(0, p * q), sigma: scaled(p * q), alone: scaled(p * q + p), errors: row.slice(p * q + 2 * p) };
  };
  // A measurement of parameter i with the share m of its sigma adds 1 / m² to the information: an update of rank one.
  const computed = (place) => {
    const c = data.correlation.map((row) => [...row]), alone = [...data.alone];
    place.forEach((step, i) => {
      const m = shares[step];
      if (m === null) return;
      const row = [...c[i]], total = row[i] + m * m;
      for (let a = 0; a < q; a++) for (let b = 0; b < q; b++) c[a][b] -= row[a] * row[b] / total;
      alone[i] = 1 / Math.hypot(1 / alone[i], 1 / (m * data.sigma[i]));
    });
    const root = c.map((row, i) => Math.sqrt(Math.max(row[i], 0)));
    const sigma = data.sigma.map((s, i) => s * root[i]);
    const r = c.slice(0, p).flatMap((row, a) => row.map((value, b) => Math.max(-1, Math.min(1, value / (root[a] * root[b])))));
    const scaled = (values) => parameters.map((one, i) => values[i] / one.scale);
    return { r, sigma: scaled(sigma), alone: scaled(alone), errors: sigma.slice(p) };
  };
  const numbers = study ? lookedUp : computed;
  // First the strongest pair of parameters, and along the axis that changes the first error most.
  let chosen = [0, 0], largest = 0;
  numbers(at)?.r.forEach((r, k) => {
    const [i, j] = [Math.floor(k / q), k % q];
    if (i < j && j < p && Math.abs(r) > largest) { chosen = [i, j]; largest = Math.abs(r); }
  });
  const sweep = (k) => axes[k].values.map((_, i) => numbers(at.map((step, axis) => axis === k ? i : step)));
  const change = (k) => {
    const found = sweep(k).map((one) => one?.errors[0]).filter((x) => known(x) && x > 0);
    return found.length ? Math.max(...found) / Math.min(...found) : 0;
  };
  let along = study ? axes.reduce((best, _, k) => change(k) > change(best) ? k : best, 0) : chosen[0];

  // Controls.
  const said = find(".said"), here = find(".here"), table = find("table"), charts = root.querySelectorAll("svg.chart");
  const sliders = axes.map((axis, k) => {
    const label = make("label", find(".sliders"));
    make("span", label, {}, axis.name);
    const output = make("output", label);
    const input = make("input", label, { type: "range", min: 0, max: axis.values.length - 1, step: 1, value: at[k] });
    input.addEventListener("input", () => { at[k] = Number(input.value); along = k; draw(); });
    input.addEventListener("focus", () => { if (along !== k) { along = k; draw(); } });
    return () => {
      const words = axis.words[at[k]];
      input.value = at[k];
      output.textContent = words;
      input.setAttribute("aria-valuetext", words);
      label.classList.toggle("along", k === along);
    };
  });
  make("button", find(".sliders"), { type: "button" }, "Reset").addEventListener("click", () => {
    axes.forEach((axis, k) => { at[k] = axis.start; });
    draw();
  });

  // The matrix, in place of that for readers without a script: one cell takes the focus, arrow keys move it.
  table.replaceChildren();
  const head = make("tr", make("thead", table)), body = make("tbody", table);
  for (const name of ["", ...names, "σ", "price"]) make("th", head, { scope: "col" }, name);
  const cells = parameters.map((parameter, i) => {
    const row = make("tr", body);
    make("th", row, { scope: "row" }, parameter.name);
    const made = names.map((_, j) => {
      const cell = make("td", row, { tabindex: -1 });
      const choose = () => { if (chosen[0] !== i || chosen[1] !== j) { chosen = [i, j]; draw(); } };
      cell.addEventListener("focus", choose);
      cell.addEventListener("click", choose);
      cell.addEventListener("pointerenter", () => { said.textContent = pairWords(i, j); });
      cell.addEventListener("keydown", (event) => {
        const [down, right] = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key] || [0, 0];
        const next = cells[i + down]?.made[j + right];
        if ((down || right) && next) { event.preventDefault(); next.focus(); }
      });
      return cell;
    });
    return { made, sigma: make("td", row, { class: "n" }), price: make("td", row, { class: "n" }) };
  });
  table.addEventListener("pointerleave", () => { said.textContent = pairWords(...chosen); });
  const pairWords = (i, j) => {
    const now = numbers(at), one = parameters[i];
    if (!now) return "No cell has numbers here.";
    const r = now.r[i * q + j];
    if (!known(r)) return `${one.name} and ${names[j]}: this model does not have both.`;
    if (i === j) return `σ of ${one.name}: ${number(now.sigma[i])}${unit(one.unit)}; ${number(now.alone[i])}${unit(one.unit)} if all other parameters were known.`;
    const other = j < p ? names[j] : `${names[j]} of the common rotation`;
    return `${one.name} and ${other}: correlation ${correlation(r)}, which by itself multiplies σ by ${number(1 / Math.sqrt(Math.max(1 - r * r, 1e-8)))}.`;
  };

  // A chart: series [{name, values}], along the steps of the axis; `to` and `from` make the scale.
  const scales = {
    log: { to: Math.log10, ticks: (low, high) => {
      const subs = high / low < 30 ? [1, 2, 5] : [1], every = Math.ceil(Math.log10(high / low) / 6), found = [];
      for (let e = Math.floor(Math.log10(low)); e <= Math.log10(high); e += every) for (const s of subs) found.push(s * 10 ** e);
      return found;
    }, ends: (all) => [Math.min(...all) / 1.3, Math.max(...all) * 1.3], text: number },
    z: { to: Math.atanh, ticks: () => [0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 0.9999],
      ends: (all) => [0, Math.tanh(Math.atanh(Math.max(...all, 0.5)) * 1.05 + 0.05)], text: String },
  };
  const shapes = ["m-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0", "m-4 -4h8v8h-8z", "m0 -5l5 5l-5 5l-5 -5z"];
  const chart = (svg, title, series, kind, of, line) => {
    const axis = axes[along], n = axis.values.length, { to, ticks, ends, text } = scales[kind];
    const [left, right, top, bottom] = [52, 408, 46, 226], usable = (v) => known(v) && (kind !== "log" || v > 0);
    svg.replaceChildren();
    svg.setAttribute("aria-label", `${title} along ${axis.name}: ` + series.map((s) => `${s.name} ${number(s.values[at[along]])}${unit(of)}`).join(", "));
    make("text", svg, { x: 4, y: 14, class: "title" }, of ? `${title} [${of}]` : title);
    const all = series.flatMap((s) => s.values.filter(usable));
    if (!all.length) { make("text", svg, { x: 210, y: 130, "text-anchor": "middle" }, "No cell has numbers here."); return; }
    const [low, high] = ends(line ? [...all, line] : all);
    const x = (i) => n === 1 ? (left + right) / 2 : left + 10 + (right - left - 20) * i / (n - 1);
    const y = (v) => bottom - (bottom - top) * (to(v) - to(low)) / (to(high) - to(low));
    make("rect", svg, { x: x(at[along]) - 7, y: top, width: 14, height: bottom - top, class: "now" });
    for (const tick of ticks(low, high).filter((t) => t >= low && t <= high)) {
      if (kind === "z" && tick && y(tick) > bottom - 14) continue;
      make("path", svg, { d: `M${left} ${y(tick)}H${right}`, class: "grid" });
      make("text", svg, { x: left - 6, y: y(tick) + 4, "text-anchor": "end" }, text(tick));
    }
    // Numbers are joined by lines, and as many are printed as there is room for; names stand apart, in two rows.
    const numeric = axis.values.every((value) => /^(none|[−0-9.\s]+σ?)$/.test(value));
    const long = Math.max(...axis.values.map((value) => value.length)), every = numeric ? Math.ceil(n * long * 7 / (right - left)) : 1;
    axis.values.forEach((value, i) => {
      if (i !== n - 1 && (i % every || i && n - 1 - i < every)) return;
      const short = value.length > 20 ? `${value.slice(0, 19)}…` : value, reach = 3.5 * short.length;
      const middle = Math.max(reach, Math.min(420 - reach, x(i)));
      make("text", svg, { x: middle, y: bottom + 16 + (numeric ? 0 : 12 * (i % 2)), "text-anchor": "middle" }, short);
    });
    make("text", svg, { x: (left + right) / 2, y: bottom + (numeric ? 34 : 41), "text-anchor": "middle" }, axis.label);
    if (line) make("path", svg, { d: `M${left} ${y(line)}H${right}`, class: "target" });
    let start = 6;
    series.forEach((s, k) => {
      const mark = (i, v, extra) => make("path", svg, { d: `M${i} ${v}${shapes[k]}`, class: `mark s${k} ${extra}` });
      mark(start + 5, 32, "");
      const name = make("text", svg, { x: start + 13, y: 36 }, s.name);
      start += 26 + (name.getComputedTextLength() || 6.4 * s.name.length);
      // The first lines are wider: where two coincide, both are seen.
      const path = s.values.map((v, i) => usable(v) ? `${numeric && i && usable(s.values[i - 1]) ? "L" : "M"}${x(i)} ${y(v)}` : "").join("");
      make("path", svg, { d: path, class: `line s${k}`, style: `stroke-width:${1.6 + 2.2 * (series.length - 1 - k)}` });
    });
    if (line) make("text", svg, { x: right, y: y(line) - 5, "text-anchor": "end", class: "target" }, `target ${number(line)} ${of}`);
    series.forEach((s, k) => s.values.forEach((v, i) => {
      if (!usable(v)) return;
      const words = `${s.name} at ${axis.name} ${axis.words[i]}: ${kind === "z" ? correlation(v) : number(v)}${unit(of)}`;
      const point = make("g", svg, { class: i === at[along] ? "at" : "" });
      make("title", point, {}, words);
      make("path", point, { d: `M${x(i)} ${y(v)}${shapes[k]}`, class: `mark s${k}` });
      make("circle", point, { cx: x(i), cy: y(v), r: 11, class: "hit" });
      point.addEventListener("pointerenter", () => { said.textContent = words; });
      point.addEventListener("click", () => { at[along] = i; draw(); });
    }));
  };

  const draw = () => {
    const now = numbers(at);
    const line = sweep(along);
    const series = (name, of) => ({ name, values: line.map((one) => one && of(one)) });
    sliders.forEach((update) => update());
    cells.forEach((row, i) => {
      row.made.forEach((cell, j) => {
        const r = now ? now.r[i * q + j] : null;
        cell.textContent = i === j && known(r) ? "1" : correlation(r);
        cell.className = known(r) ? Math.abs(r) > 0.6 ? "strong" : "" : "none";
        cell.style.setProperty("--r", known(r) ? `${Math.round(100 * Math.abs(r))}%` : "0%");
        cell.style.setProperty("--hue", r < 0 ? "#2166ac" : "#b2182b");
        cell.setAttribute("aria-label", `${parameters[i].name} and ${names[j]}: ${cell.textContent || "none"}`);
        const selected = chosen[0] === i && chosen[1] === j;
        cell.tabIndex = selected ? 0 : -1;
        cell.toggleAttribute("aria-selected", selected);
        cell.classList.toggle("chosen", selected);
      });
      const sigma = now && now.sigma[i];
      row.sigma.textContent = known(sigma) ? `${number(sigma)}${unit(parameters[i].unit)}` : "–";
      row.price.textContent = known(sigma) ? `× ${number(sigma / now.alone[i])}` : "–";
    });
    here.replaceChildren();
    make("dt", here, { class: "title" }, `${headline}:`);
    errors.forEach((error, k) => {
      make("dt", here, {}, error);
      make("dd", here, { "data-error": k }, now ? `${number(now.errors[k])} arcsec` : "–");
    });
    if (target && now) {
      make("dt", here, {}, `target ${number(target)} arcsec`);
      make("dd", here, { class: now.errors[0] <= target ? "met" : "missed" }, now.errors[0] <= target ? "✓ met" : "✗ not met");
    }
    chart(charts[0], headline, errors.map((error, k) => series(error, (one) => one.errors[k])), "log", "arcsec", target);
    const [i, j] = chosen, one = parameters[i];
    if (i === j) {
      chart(charts[1], `σ of ${one.name}`, [series("all others unknown", (of) => of.sigma[i]), series("all others known", (of) => of.alone[i])], "log", one.unit);
    } else {
      const size = series(`${one.name} and ${names[j]}`, (of) => known(of.r[i * q + j]) ? Math.min(Math.abs(of.r[i * q + j]), 0.99999) : null);
      chart(charts[1], "Size of the correlation", [size], "z", "");
    }
    said.textContent = pairWords(i, j);
  };
  root.classList.add("live");
  draw();
})();
