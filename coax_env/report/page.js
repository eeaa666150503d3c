// Draws the page's figures when they come near the screen, in the reader's colours.
const dark = matchMedia('(prefers-color-scheme: dark)');
let printing = false;
const theme = () => THEMES[dark.matches && !printing ? 'dark' : 'light'];

function draw(plot) {
  if (plot.dataset.drawn || plot.closest('[hidden]') || plot.closest('details:not([open])')) return;
  plot.dataset.drawn = '1';
  const content = JSON.parse(plot.nextElementSibling.textContent);
  const layout = Object.assign({}, content.layout, {template: theme()});
  Plotly.newPlot(plot, content.data, layout, {responsive: true, displayModeBar: false});
}
const drawAll = () => document.querySelectorAll('.plot').forEach(draw);
function restyle() {
  document.querySelectorAll('.plot[data-drawn]').forEach(
    plot => Plotly.relayout(plot, {template: theme()}));
}
dark.addEventListener('change', restyle);
addEventListener('beforeprint', () => { printing = true; drawAll(); restyle(); });
addEventListener('afterprint', () => { printing = false; restyle(); });

document.querySelectorAll('.chooser').forEach(chooser => {
  const lists = [...chooser.querySelectorAll('select')];
  const choices = [...chooser.querySelectorAll('.choice')];
  const show = () => {
    const key = lists.map(list => list.value).join('|');
    choices.forEach(choice => { choice.hidden = choice.dataset.key !== key; });
    chooser.querySelector('.none').hidden = choices.some(choice => !choice.hidden);
    chooser.querySelectorAll('.plot').forEach(draw);
  };
  lists.forEach(list => list.addEventListener('change', show));
  show();
});
document.querySelectorAll('details').forEach(d => d.addEventListener('toggle', () => {
  d.querySelectorAll('.plot').forEach(draw);
}));

const near = new IntersectionObserver(seen => seen.forEach(one => {
  if (one.isIntersecting) { draw(one.target); near.unobserve(one.target); }
}), {rootMargin: '1200px'});
document.querySelectorAll('.plot').forEach(plot => near.observe(plot));
