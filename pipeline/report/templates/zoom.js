"use strict";
for (const box of document.querySelectorAll(".zoom")) {
  const svg = box.querySelector("svg");
  const whole = { x: -0.5, y: -0.5, w: +box.dataset.width, h: +box.dataset.height };
  const most = Math.max(whole.w / 24, 1);
  let view = { ...whole };
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
  function measure() { // marks and names keep their size on the screen, marks grow a little with the zoom
    const pixel = view.w / Math.max(svg.clientWidth, 1);
    svg.style.setProperty("--screen-px", pixel);
    svg.style.setProperty("--mark", pixel * Math.min(1, svg.clientWidth / 700) * Math.sqrt(whole.w / view.w));
  }
  function show(next) {
    const w = clamp(next.w, whole.w / most, whole.w);
    const h = w * whole.h / whole.w;
    view = { w, h, x: clamp(next.x, whole.x, whole.x + whole.w - w), y: clamp(next.y, whole.y, whole.y + whole.h - h) };
    svg.setAttribute("viewBox", `${view.x} ${view.y} ${view.w} ${view.h}`);
    svg.classList.toggle("closer", view.w < whole.w * 0.999);
    measure();
    box.dispatchEvent(new CustomEvent("zoomed", { detail: view }));
  }
  box.zoomTo = (x, y, w) => { // a view `w` wide about (x, y)
    const wide = clamp(w, whole.w / most, whole.w);
    show({ w: wide, x: x - wide / 2, y: y - wide * whole.h / whole.w / 2 });
  };
  const marks = [...svg.querySelectorAll("[style*='--x']")].map(({ style }) => ({ x: +style.getPropertyValue("--x"), y: +style.getPropertyValue("--y") }));
  function middle(w) { // of the view, or the mark nearest to it where a view `w` wide would show none
    const x = view.x + view.w / 2, y = view.y + view.h / 2, h = w * whole.h / whole.w;
    const off = (mark) => Math.max(Math.abs(mark.x - x) / w, Math.abs(mark.y - y) / h);
    const nearest = marks.reduce((best, mark) => (off(mark) < off(best) ? mark : best), marks[0] || { x, y });
    if (off(nearest) <= 0.45) return { x, y };
    view = { ...view, x: nearest.x - view.w / 2, y: nearest.y - view.h / 2 };
    return nearest;
  }
  function zoom(factor, at) {
    const w = clamp(view.w / factor, whole.w / most, whole.w);
    const centre = at || middle(w);
    const ratio = w / view.w;
    show({ w, x: centre.x - (centre.x - view.x) * ratio, y: centre.y - (centre.y - view.y) * ratio });
  }
  function pointOf(event) {
    const edge = svg.getBoundingClientRect();
    return { x: view.x + (event.clientX - edge.left) / edge.width * view.w, y: view.y + (event.clientY - edge.top) / edge.height * view.h };
  }
  box.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button || button.dataset.layer) return;
    if (button.dataset.marks) {
      const bare = box.classList.toggle("bare");
      button.setAttribute("aria-pressed", String(!bare));
    } else if (+button.dataset.zoom) zoom(+button.dataset.zoom);
    else show(whole);
  });
  svg.addEventListener("dblclick", (event) => zoom(2, pointOf(event)));
  svg.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && view.w >= whole.w * 0.999) return; // the page scrolls until the image has been zoomed
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * 0.002), pointOf(event));
  }, { passive: false });
  svg.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (event.key === "+" || event.key === "=") zoom(1.5);
    else if (event.key === "-") zoom(1 / 1.5);
    else if (event.key === "0") show(whole);
    else if (step && view.w < whole.w) show({ ...view, x: view.x + step[0] * view.w * 0.1, y: view.y + step[1] * view.h * 0.1 });
    else return;
    event.preventDefault();
  });
  new ResizeObserver(measure).observe(svg);
  const fingers = new Map();
  let last = null;
  svg.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, event);
    last = null;
    if (view.w < whole.w * 0.999) svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const before = fingers.get(event.pointerId);
    fingers.set(event.pointerId, event);
    const edge = svg.getBoundingClientRect();
    if (fingers.size === 2) {
      const [a, b] = [...fingers.values()];
      const distance = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (last) zoom(distance / last, pointOf({ clientX: (a.clientX + b.clientX) / 2, clientY: (a.clientY + b.clientY) / 2 }));
      last = distance;
    } else if (view.w < whole.w * 0.999) {
      show({ ...view, x: view.x - (event.clientX - before.clientX) / edge.width * view.w, y: view.y - (event.clientY - before.clientY) / edge.height * view.h });
    }
  });
  for (const end of ["pointerup", "pointercancel", "pointerleave"]) svg.addEventListener(end, (event) => { fingers.delete(event.pointerId); last = null; });
}
