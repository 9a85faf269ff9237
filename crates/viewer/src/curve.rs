//! The curves of a run as an SVG picture, over joint steps. It has a dark mode: one style block holds every colour.

mod axis;
pub mod systems;

use crate::plots::{self, LOG_FROM, Plot};
use axis::{Axis, labels, limits, short_count, ticks};
use magex_core::error::FieldError;
use magex_core::metrics_table::{EPISODE_RETURN, Kind, Look, METRICS, Scale};
use serde::Deserialize;
use serde_json::{Map, Value};
use std::fmt::Write as _;

/// One line of `metrics.jsonl`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct MetricsLine {
    /// Number of the line.
    pub iteration: u64,
    /// Steps of whole teams since the start of the run.
    pub joint_env_steps: u64,
    /// Everything else on the line.
    #[serde(flatten)]
    values: Map<String, Value>,
}

impl MetricsLine {
    /// A number by its place: its keys with `/` between them. `None` if the line does not have it, or has it as null.
    pub fn get(&self, place: &str) -> Option<f64> {
        let mut keys = place.split('/');
        let first = keys.next().and_then(|key| self.values.get(key));
        keys.fold(first, |value, key| value?.get(key)).and_then(Value::as_f64)
    }
}

/// Reads a metrics file. An unterminated last line is ignored (the run may be writing it). If a number occurs twice because
/// the run was resumed before it, the later line counts. A file without lines is refused.
pub fn parse_metrics(text: &str) -> Result<Vec<MetricsLine>, FieldError> {
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    let mut lines: Vec<MetricsLine> = Vec::new();
    for (index, line) in whole.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let line: MetricsLine = serde_json::from_str(line)
            .map_err(|error| FieldError::new(format!("metrics.jsonl line {}", index + 1), error.to_string()))?;
        while lines.last().is_some_and(|last| last.iteration >= line.iteration) {
            lines.pop();
        }
        lines.push(line);
    }
    if lines.is_empty() { Err(empty()) } else { Ok(lines) }
}

fn empty() -> FieldError {
    FieldError::new("metrics.jsonl", "no iterations yet; wait for the first one to finish")
}

/// A plot with its points.
struct Panel {
    plot: Plot,
    curves: Vec<Curve>,
    /// Whether its vertical axis is logarithmic.
    log: bool,
}

struct Curve {
    look: Look,
    /// `[joint steps, value]`
    points: Vec<[f64; 2]>,
}

impl Panel {
    /// The panel of a plot, if the run has what it shows.
    fn of(plot: Plot, lines: &[MetricsLine], external: bool) -> Option<Self> {
        let curves: Vec<Curve> =
            plot.series.iter().map(|one| Curve { look: one.kind.look(), points: points(lines, one.place) }).collect();
        let mut panel = Self { plot, curves, log: false };
        let values = panel.values();
        let (low, high) = values.iter().fold((f64::INFINITY, 0.0), |(low, high), &y| (y.min(low), y.max(high)));
        panel.log = panel.plot.log && low > 0.0 && high > LOG_FROM * low;
        let always = panel.plot.always && !external;
        (always || values.iter().any(|&value| value != 0.0)).then_some(panel)
    }

    fn values(&self) -> Vec<f64> {
        self.curves.iter().flat_map(|one| &one.points).map(|&[_, y]| y).collect()
    }

    fn title(&self) -> String {
        let log = if self.log { "log scale" } else { "" };
        let parts = [&self.plot.title, self.plot.unit.as_str(), log];
        parts.into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join(", ")
    }

    /// One line in place of a plot, if every value is as good as it can be.
    fn in_a_word(&self) -> Option<String> {
        let (ideal, values) = (self.plot.write(self.plot.ideal()?), self.values());
        let constant = !values.is_empty() && values.iter().all(|&value| self.plot.write(value) == ideal);
        constant.then(|| format!("{}: {ideal} throughout, which is the best there is", self.title()))
    }
}

const WIDTH: f64 = 960.0;
const MARGIN: f64 = 24.0;
/// Between the two columns.
const GUTTER: f64 = 36.0;
/// Height of the picture's title.
const HEADER: f64 = 72.0;
/// Height of a panel's title and legend, of its horizontal axis with the gap below, and of the plots.
const TITLE: f64 = 48.0;
const AXIS: f64 = 40.0;
const LARGE: f64 = 210.0;
const SMALL: f64 = 120.0;
/// Height of a line of text.
const LINE: f64 = 22.0;
const FOOTER: f64 = 30.0;
/// Widest digit of the fonts in question, in pixels.
const DIGIT: f64 = 8.0;

/// The picture of at least one line as SVG text. `title` is the run's name, `subtitle` its configuration in one line.
pub fn curve_svg(title: &str, subtitle: &str, lines: &[MetricsLine]) -> Result<String, FieldError> {
    let last = lines.last().ok_or_else(empty)?.joint_env_steps.max(1) as f64;
    let plots = plots::all().into_iter().filter(|plot| plot.picture);
    // An environment of the user's own has a return, and what the simulated tasks always have only by chance.
    let external = lines.iter().any(|line| line.get(METRICS[EPISODE_RETURN].name).is_some());
    let panels = plots.filter_map(|plot| Panel::of(plot, lines, external));
    let (constant, panels): (Vec<_>, Vec<_>) = panels.partition(|panel| panel.in_a_word().is_some());
    let mut svg = Svg { body: String::new(), last };
    let mut top = HEADER;
    let main =
        |plot: &Plot| if external { plot.id == METRICS[EPISODE_RETURN].name } else { plot.scale == Scale::Share };
    let (large, small): (Vec<_>, Vec<_>) = panels.iter().partition(|panel| main(&panel.plot));
    for panel in large {
        svg.panel(panel, [MARGIN, WIDTH - MARGIN], top, LARGE);
        top += TITLE + LARGE + AXIS;
    }
    let column = (WIDTH - 2.0 * MARGIN - GUTTER) / 2.0;
    for row in small.chunks(2) {
        for (panel, left) in row.iter().zip([MARGIN, MARGIN + column + GUTTER]) {
            svg.panel(panel, [left, left + column], top, SMALL);
        }
        top += TITLE + SMALL + AXIS;
    }
    for words in constant.iter().filter_map(Panel::in_a_word) {
        svg.text([MARGIN, top + 8.0], "start", "ink", &words);
        top += LINE;
    }
    svg.text(
        [MARGIN, top + 8.0],
        "start",
        "soft",
        "Horizontal axes: joint environment steps. Beside a name: its last value.",
    );
    let height = top + FOOTER;
    let mut head = Svg { body: String::new(), last };
    head.text([MARGIN, 34.0], "start", "ink name", title);
    head.text([MARGIN, 54.0], "start", "soft", subtitle);
    let looks = Kind::ALL.map(Kind::look).map(|look| (look.class, look.light, look.dark));
    Ok(format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" viewBox=\"0 0 {WIDTH} {height}\" \
         role=\"img\">\n<title>Learning curves of {}</title>\n<style>\n{}</style>\n\
         <rect class=\"page\" width=\"100%\" height=\"100%\"/>\n{}{}</svg>\n",
        escape(title),
        style(frame().into_iter().chain(looks).collect(), ""),
        head.body,
        svg.body
    ))
}

/// Every colour of the picture, light and dark, as the property `color` of classes; shapes take theirs from it. `more` are rules
/// without colours.
fn style(colours: Vec<(&str, &str, &str)>, more: &str) -> String {
    let light: String = colours.iter().map(|(class, light, _)| format!(".{class}{{color:{light}}}")).collect();
    let dark: String = colours.iter().map(|(class, _, dark)| format!(".{class}{{color:{dark}}}")).collect();
    format!(
        "svg{{font:13px Inter,'Segoe UI',Roboto,'DejaVu Sans',sans-serif}}\
         rect,text,tspan,circle{{fill:currentColor}}line,polyline{{stroke:currentColor;fill:none;stroke-linejoin:round}}\
         .name{{font-size:22px;font-weight:600}}.title{{font-size:14px}}.label{{font-size:12px}}\n\
         {more}{light}\n@media (prefers-color-scheme: dark){{{dark}}}\n"
    )
}

/// Colours of what is around the curves.
fn frame() -> [(&'static str, &'static str, &'static str); 4] {
    [
        ("page", "#ffffff", "#191d26"),
        ("ink", "#1b1f27", "#e8ebf1"),
        ("soft", "#5d6879", "#9aa4b6"),
        ("grid", "#e4e7ec", "#2c3341"),
    ]
}

struct Svg {
    body: String,
    /// End of the horizontal axes, which begin at 0.
    last: f64,
}

// Writing to a string cannot fail.
impl Svg {
    fn text(&mut self, [x, y]: [f64; 2], anchor: &str, class: &str, text: &str) {
        let text = escape(text);
        let _ = writeln!(
            self.body,
            "<text class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{text}</text>"
        );
    }

    fn line(&mut self, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2]) {
        let _ =
            writeln!(self.body, "<line class=\"grid\" x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\"/>");
    }

    fn panel(&mut self, panel: &Panel, [left, right]: [f64; 2], head: f64, height: f64) {
        let (top, bottom) = (head + TITLE, head + TITLE + height);
        let (low, high) = limits(panel.plot.scale, panel.log, &panel.values());
        let y = Axis { from: low, to: high, start: bottom, end: top, log: panel.log };
        let rows = y.ticks(6);
        let names = match panel.plot.scale {
            Scale::Share => rows.iter().map(|tick| format!("{:.0} %", 100.0 * tick)).collect(),
            _ => labels(&rows, panel.log),
        };
        // The plot begins behind the widest label.
        let widest = names.iter().map(|name| name.chars().count()).max().unwrap_or(0);
        let start = left + DIGIT * widest as f64 + 8.0;
        for (&tick, name) in rows.iter().zip(&names) {
            self.line([start, y.at(tick)], [right, y.at(tick)]);
            self.text([start - 8.0, y.at(tick) + 4.0], "end", "soft label", name);
        }
        let x = Axis { from: 0.0, to: self.last, start, end: right, log: false };
        for tick in ticks(0.0, self.last, if height > SMALL { 10 } else { 6 }) {
            self.line([x.at(tick), top], [x.at(tick), bottom]);
            self.text([x.at(tick), bottom + 17.0], "middle", "soft label", &short_count(tick));
        }
        self.text([left, head + 12.0], "start", "ink title", &panel.title());
        self.legend(panel, [left, head + 31.0]);
        for one in &panel.curves {
            self.curve(one, &x, &y);
        }
    }

    /// A line through the points; with dots where they are few.
    fn curve(&mut self, Curve { look, points }: &Curve, x: &Axis, y: &Axis) {
        let (class, dots) = (look.class, points.len() <= 60);
        let width = if dots { 2.0 } else { 1.2 };
        let places: Vec<[f64; 2]> = points.iter().map(|&[step, value]| [x.at(step), y.at(value)]).collect();
        let path: Vec<String> = places.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
        let path = path.join(" ");
        let _ = writeln!(self.body, "<polyline class=\"{class}\" points=\"{path}\" stroke-width=\"{width}\"/>");
        for [x, y] in places.iter().filter(|_| dots) {
            let _ = writeln!(self.body, "<circle class=\"{class}\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.6\"/>");
        }
    }

    /// Label and last value of every series.
    fn legend(&mut self, panel: &Panel, [x, y]: [f64; 2]) {
        let _ = write!(self.body, "<text class=\"label\" x=\"{x:.1}\" y=\"{y:.1}\">");
        for (k, Curve { look, points }) in panel.curves.iter().enumerate() {
            let value = points.last().map_or("no data yet".to_owned(), |&[_, value]| panel.plot.write(value));
            let gap = if k == 0 { "" } else { " dx=\"18\"" };
            let _ = write!(self.body, "<tspan class=\"{}\"{gap}>━ {} {value}</tspan>", look.class, look.label);
        }
        self.body += "</text>\n";
    }
}

/// `[joint steps, value]` of every line that has a finite value.
fn points(lines: &[MetricsLine], place: &str) -> Vec<[f64; 2]> {
    let point = |line: &MetricsLine| Some([line.joint_env_steps as f64, line.get(place).filter(|y| y.is_finite())?]);
    lines.iter().filter_map(point).collect()
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests;
