//! The clock of missions. Lifetimes must not depend on the time of day: machines without a battery clock start in 1970, and a
//! time server corrects them minutes later.
//!
//! The clock counts milliseconds and never jumps: while a service runs it follows the time since the machine's boot, which also
//! counts while the machine sleeps. Every change of a mission writes it down ([`Mark`]). After a restart it goes on from there,
//! advanced by the time in between as far as that is certain: within one boot of the machine by the smaller of what the time
//! since boot and the time of day say, and after another boot not at all. So no jump, of either, takes a mission away.
//!
//! Clients see times of day. Those of the past stay as they were shown; the expiry follows the time of day when it jumps.

use rustix::time::{ClockId, clock_gettime};
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

/// The time of day drifts against the clock while a time server steers it; a difference above this is a jump, milliseconds.
const JUMP: i64 = 1000;

/// A moment: on the clock of missions, and as the time of day (milliseconds since 1970).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Now {
    /// Lifetimes and ages.
    pub clock_ms: i64,
    /// What clients are shown.
    pub day_ms: i64,
}

/// Both are the same.
impl From<i64> for Now {
    fn from(ms: i64) -> Self {
        Self { clock_ms: ms, day_ms: ms }
    }
}

impl Now {
    /// The time of day at which the clock will show this.
    pub fn day_of(&self, clock_ms: i64) -> i64 {
        clock_ms.saturating_add(self.day_ms - self.clock_ms)
    }
}

/// The clock as it is written down.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Mark {
    /// The clock of missions.
    pub clock_ms: i64,
    /// Time since boot.
    pub boot_ms: i64,
    /// Which boot of which machine; 0 if unknown.
    pub boot: u64,
    /// Time of day.
    pub day_ms: i64,
}

impl Mark {
    /// What the clock shows at `now`, whose own clock does not count.
    fn advanced_to(&self, now: &Self) -> i64 {
        let same_boot = self.boot == now.boot && self.boot != 0;
        let passed = (now.boot_ms - self.boot_ms).min(now.day_ms - self.day_ms).max(0);
        self.clock_ms + if same_boot { passed } else { 0 }
    }
}

/// The clock.
#[derive(Debug)]
pub struct Clock {
    /// The clock minus the time since boot.
    offset: i64,
    boot: u64,
    /// The time of day minus the clock, as clients see it.
    day: AtomicI64,
}

impl Clock {
    /// Goes on from a mark; without one the clock begins at the time of day.
    pub fn resume(mark: Option<Mark>) -> Self {
        let now = Mark { clock_ms: 0, boot_ms: since_boot(), boot: this_boot(), day_ms: time_of_day() };
        let clock = mark.map_or(now.day_ms, |mark| mark.advanced_to(&now));
        let real = now.day_ms - clock;
        // Without a jump, clients see the same times as before.
        let known = mark.map(|mark| mark.day_ms - mark.clock_ms).filter(|known| (known - real).abs() <= JUMP);
        Self { offset: clock - now.boot_ms, boot: now.boot, day: AtomicI64::new(known.unwrap_or(real)) }
    }

    /// The moment now, and by how much the time of day has jumped since the last call, milliseconds.
    pub fn now(&self) -> (Now, Option<i64>) {
        let (clock_ms, day) = (since_boot() + self.offset, self.day.load(Ordering::Relaxed));
        let jump = time_of_day() - clock_ms - day;
        let jumped = jump.abs() > JUMP;
        let day = if jumped { day + jump } else { day };
        self.day.store(day, Ordering::Relaxed);
        (Now { clock_ms, day_ms: clock_ms + day }, jumped.then_some(jump))
    }

    /// The clock, to be written down.
    pub fn mark(&self) -> Mark {
        let (now, _) = self.now();
        Mark { clock_ms: now.clock_ms, boot_ms: now.clock_ms - self.offset, boot: self.boot, day_ms: now.day_ms }
    }
}

fn since_boot() -> i64 {
    let time = clock_gettime(ClockId::Boottime);
    time.tv_sec * 1000 + time.tv_nsec / 1_000_000
}

/// A number for this boot of this machine.
fn this_boot() -> u64 {
    let id = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    let digits: String = id.chars().filter(char::is_ascii_hexdigit).take(16).collect();
    u64::from_str_radix(&digits, 16).unwrap_or(0)
}

#[allow(
    clippy::disallowed_methods,
    reason = "shown to clients, and compared over restarts; no lifetime runs on it alone"
)]
fn time_of_day() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as i64)
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOUR: i64 = 3_600_000;

    #[test]
    fn over_a_restart_only_certain_time_passes() {
        let before = Mark { clock_ms: 500, boot_ms: 1000, boot: 7, day_ms: 90 * HOUR };
        let after = |boot, boot_ms: i64, day_ms: i64| {
            before.advanced_to(&Mark { clock_ms: 0, boot_ms: 1000 + boot_ms, boot, day_ms: 90 * HOUR + day_ms }) - 500
        };
        assert_eq!(after(7, HOUR, HOUR), HOUR);
        // The time of day jumps, or the time since boot (a container that moves into another time namespace).
        for (boot_ms, day_ms) in [(5, 2 * HOUR), (5, -2 * HOUR), (2 * HOUR, 5), (-2 * HOUR, 5)] {
            assert!((0..=5).contains(&after(7, boot_ms, day_ms)), "{boot_ms} {day_ms}");
        }
        // Another boot, or an unknown one.
        assert_eq!((after(8, HOUR, HOUR), after(8, -900, 400_000 * HOUR)), (0, 0));
        assert_eq!(Mark { boot: 0, ..before }.advanced_to(&Mark { boot: 0, boot_ms: 9000, ..before }), 500);
    }

    #[test]
    fn the_clock_goes_on_from_its_mark() {
        let first = Clock::resume(None);
        let mark = Mark { clock_ms: 12_345, ..first.mark() };
        let (now, jump) = Clock::resume(Some(mark)).now();
        assert!((12_345..12_345 + HOUR).contains(&now.clock_ms) && jump.is_none(), "{now:?}");
        assert!((now.day_ms - time_of_day()).abs() < HOUR);
        // Over a restart without a jump, what is shown does not change.
        let (before, _) = first.now();
        let (after, _) = Clock::resume(Some(first.mark())).now();
        assert_eq!(after.day_of(0), before.day_of(0));
        assert_eq!(Now { clock_ms: 10, day_ms: 1010 }.day_of(25), 1025);
    }
}
