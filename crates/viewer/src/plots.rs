//! Every plot of a run: what curve.svg and the live page draw, under one title and in one colour per quantity.
//!
//! The episode metrics come from the table of metrics; the numbers of the updates are rows here.

use magex_core::metrics_table::{Format, Kind, METRICS, Metric, Scale, Scope, share};

/// A positive quantity whose largest value is more than this many times its smallest is drawn on a logarithmic axis, if
/// its plot allows one.
pub(crate) const LOG_FROM: f64 = 30.0;

/// A plot.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Plot {
    /// Identifies it on the page.
    pub(crate) id: &'static str,
    /// Its title.
    pub(crate) title: String,
    /// What stands behind the title: the unit.
    pub(crate) unit: String,
    pub(crate) scale: Scale,
    /// Whether its axis may be logarithmic, see [`LOG_FROM`].
    pub(crate) log: bool,
    pub(crate) series: Vec<Series>,
    /// Whether every run has it. Others are left out where it is 0 throughout.
    pub(crate) always: bool,
    /// Whether curve.svg draws it, too. (The page draws all of them.)
    pub(crate) picture: bool,
    format: Format,
}

/// A series of a plot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Series {
    /// Its column on the page.
    pub(crate) column: &'static str,
    /// Where it is in a line of metrics.jsonl: keys with `/` between them.
    pub(crate) place: &'static str,
    /// What it is of.
    pub(crate) kind: Kind,
}

/// Of the update: plot, title, unit, logarithmic or not, in curve.svg or not, and the series.
type Update = (&'static str, &'static str, &'static str, bool, bool, &'static [(&'static str, &'static str, Kind)]);

/// Series of the executor's update.
macro_rules! series {
    ($($name:literal $kind:ident),*) => { &[$(($name, concat!("executor/", $name), Kind::$kind)),*] };
}

const UPDATES: [Update; 11] = [
    ("entropy", "Entropy", "nats per agent", false, true, series!("entropy" Actor)),
    ("policy", "Policy loss", "", false, true, series!("policy_loss" Actor)),
    ("value", "Value loss", "", true, true, series!("value_loss" Critic)),
    ("td", "TD loss", "", true, true, series!("td_loss" Critic)),
    ("q_tot", "Q_tot", "mean of the joint actions taken", false, true, series!("q_tot_mean" Critic)),
    ("epsilon", "ε", "share of random actions", false, true, series!("epsilon" Actor)),
    ("intrinsic", "Intrinsic reward", "per agent and step", false, true, series!("intrinsic_reward" Critic)),
    (
        "gradient",
        "Gradient norm",
        "before clipping",
        true,
        false,
        series!("actor_grad_norm" Actor, "critic_grad_norm" Critic),
    ),
    (
        "q_gradient",
        "Gradient norm",
        "before clipping",
        true,
        false,
        series!("agent_grad_norm" Actor, "mixer_grad_norm" Critic),
    ),
    ("divergence", "KL divergence", "from the old policy", false, false, series!("approx_kl" Actor)),
    ("commander", "Commander loss", "", false, false, &[("commander_loss", "commander/loss", Kind::Commander)]),
];

/// Every plot, in order.
pub(crate) fn all() -> Vec<Plot> {
    let updates = UPDATES.iter().map(|&(id, title, unit, log, picture, series)| Plot {
        id,
        title: title.to_owned(),
        unit: unit.to_owned(),
        scale: Scale::Free,
        log,
        series: series.iter().map(|&(column, place, kind)| Series { column, place, kind }).collect(),
        always: false,
        picture,
        format: Format::Decimals(4),
    });
    METRICS.iter().filter_map(Plot::of).chain(updates).collect()
}

impl Plot {
    /// The plot of a metric, if it has one.
    fn of(metric: &Metric) -> Option<Self> {
        let scale = metric.plot?;
        let mut letters = metric.label.chars();
        let first = letters.next().map(char::to_uppercase).into_iter().flatten();
        let remark = if metric.remark.is_empty() { String::new() } else { format!("; {}", metric.remark) };
        Some(Self {
            id: metric.name,
            title: first.chain(letters).collect(),
            unit: format!("{}{remark}", metric.unit),
            scale,
            log: false,
            series: metric.series().map(|(column, kind)| Series { column, place: column, kind }).collect(),
            always: matches!(metric.scope, Scope::EveryTask | Scope::Landmarks | Scope::Success),
            picture: true,
            format: metric.format,
        })
    }

    /// The value that cannot be better, if there is one.
    pub(crate) fn ideal(&self) -> Option<f64> {
        match self.scale {
            Scale::FromOne => Some(1.0),
            Scale::FromZero => Some(0.0),
            Scale::Share | Scale::Free => None,
        }
    }

    /// A value as text.
    pub(crate) fn write(&self, value: f64) -> String {
        match self.format {
            Format::Share => format!("{} %", percent(value)),
            Format::Decimals(digits) => format!("{value:.digits$}"),
        }
    }
}

/// A share in percent, never rounded up to 100.
fn percent(value: f64) -> String {
    share(value)
        .parse::<f64>()
        .map_or_else(|_| share(value), |rounded| format!("{:.1}", (rounded * 1000.0).floor() / 10.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn titles_units_and_series_are_those_of_the_table() {
        let plots = all();
        let of = |id: &str| plots.iter().find(|plot| plot.id == id).unwrap();
        for metric in METRICS.iter().filter(|metric| metric.plot.is_some()) {
            let plot = of(metric.name);
            assert_eq!(plot.title.to_lowercase(), metric.label);
            assert!(plot.unit.starts_with(metric.unit) && plot.unit.ends_with(metric.remark), "{}", plot.unit);
            let series: Vec<_> = plot.series.iter().map(|one| (one.column, one.kind)).collect();
            assert_eq!(series, metric.series().collect::<Vec<_>>());
        }
        assert!(of("arrival_step").unit.contains("never counts as"));
        assert!(["entropy", "policy", "value", "reward"].iter().all(|id| of(id).picture));
    }

    #[test]
    fn shares_are_never_rounded_up() {
        let plots = all();
        assert_eq!([0.0, 0.684, 0.99999, 1.0].map(|x| plots[0].write(x)), ["0.0 %", "68.4 %", "99.9 %", "100.0 %"]);
    }
}
