//! Splits long byte strings into parts with checksums, and joins them within a limit.

use crate::{PART_BYTES, v1::Part};
use bytes::Bytes;
use magex_core::error::FieldError;

/// Splits a byte string into parts of at most [`PART_BYTES`]; an empty one is a single empty part. Shares the bytes.
pub fn split(whole: Bytes) -> impl ExactSizeIterator<Item = Part> {
    let total = whole.len().div_ceil(PART_BYTES).max(1);
    let total_bytes = whole.len() as u64;
    (0..total).map(move |index| {
        let data = whole.slice(index * PART_BYTES..whole.len().min((index + 1) * PART_BYTES));
        Part { index: index as u32, total: total as u32, total_bytes, crc32c: crc32c::crc32c(&data), data }
    })
}

/// Joins parts, one byte string at a time. An error, or a part 0, starts a new one.
#[derive(Debug)]
pub struct Assembler {
    limit: usize,
    next: u32,
    total: u32,
    total_bytes: u64,
    buffer: Vec<u8>,
}

impl Assembler {
    /// An assembler for byte strings of at most `limit` bytes.
    pub fn new(limit: usize) -> Self {
        Self { limit, next: 0, total: 0, total_bytes: 0, buffer: Vec::new() }
    }

    /// Adds the next part; the last one returns the byte string. Fails beyond the limit, and if a part is missing or damaged.
    pub fn push(&mut self, part: Part) -> Result<Option<Bytes>, FieldError> {
        let taken = self.take(part);
        if !matches!(taken, Ok(None)) {
            *self = Self::new(self.limit);
        }
        taken
    }

    fn take(&mut self, part: Part) -> Result<Option<Bytes>, FieldError> {
        if part.index == 0 {
            if part.total_bytes > self.limit as u64 {
                let problem = format!("{} bytes are more than the limit of {}", part.total_bytes, self.limit);
                return Err(FieldError::new("total_bytes", problem));
            }
            *self = Self { total: part.total, total_bytes: part.total_bytes, ..Self::new(self.limit) };
        } else if part.index != self.next {
            let problem = format!("part {} of {} where part {} is expected", part.index, part.total, self.next);
            return Err(FieldError::new("index", problem));
        }
        if (part.total, part.total_bytes) != (self.total, self.total_bytes) || part.index >= part.total {
            let problem = format!(
                "part {} speaks of {} parts and {} bytes, part 0 of {} and {}",
                part.index, part.total, part.total_bytes, self.total, self.total_bytes
            );
            return Err(FieldError::new("data", problem));
        }
        let actual = crc32c::crc32c(&part.data);
        if actual != part.crc32c {
            let problem = format!("part {} has checksum {actual:08x}, its sender says {:08x}", part.index, part.crc32c);
            return Err(FieldError::new("crc32c", problem));
        }
        let last = part.index + 1 == part.total;
        let length = (self.buffer.len() + part.data.len()) as u64;
        if length > self.total_bytes || (last && length != self.total_bytes) {
            let problem = format!("{length} bytes arrived of {} announced", self.total_bytes);
            return Err(FieldError::new("data", problem));
        }
        if last && part.index == 0 {
            return Ok(Some(part.data));
        }
        if part.index == 0 {
            self.buffer.reserve_exact(self.total_bytes as usize);
        }
        self.buffer.extend_from_slice(&part.data);
        self.next = part.index + 1;
        Ok(last.then(|| std::mem::take(&mut self.buffer).into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn whole(length: usize) -> Bytes {
        (0..length).map(|i| (i * 31 % 251) as u8).collect::<Vec<_>>().into()
    }

    fn join(assembler: &mut Assembler, parts: impl IntoIterator<Item = Part>) -> Result<Option<Bytes>, FieldError> {
        let mut last = Ok(None);
        for part in parts {
            last = assembler.push(part);
            if last.is_err() {
                break;
            }
        }
        last
    }

    #[test]
    fn every_length_round_trips_within_the_part_limit() {
        let mut assembler = Assembler::new(4 * PART_BYTES);
        for length in [0, 1, PART_BYTES - 1, PART_BYTES, PART_BYTES + 1, 3 * PART_BYTES, 3 * PART_BYTES + 7] {
            let whole = whole(length);
            assert!(split(whole.clone()).all(|part| part.data.len() <= PART_BYTES));
            assert_eq!(join(&mut assembler, split(whole.clone())).unwrap(), Some(whole), "{length}");
        }
    }

    #[test]
    fn a_whole_over_the_limit_is_refused_at_its_first_part() {
        let error = Assembler::new(100).push(split(whole(101)).next().unwrap()).unwrap_err();
        assert_eq!(error, FieldError::new("total_bytes", "101 bytes are more than the limit of 100"));
    }

    #[test]
    fn damage_is_noticed_and_the_next_whole_is_unharmed() {
        let mut assembler = Assembler::new(4 * PART_BYTES);
        let good = whole(2 * PART_BYTES);
        let parts: Vec<Part> = split(good.clone()).collect();
        let check = |assembler: &mut Assembler, damage: fn(&mut Vec<Part>), words: &str| {
            let mut parts = parts.clone();
            damage(&mut parts);
            let error = join(assembler, parts).unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
            assert_eq!(join(assembler, split(good.clone())).unwrap(), Some(good.clone()));
        };
        check(&mut assembler, |p| p[1].crc32c ^= 1, "checksum");
        check(&mut assembler, |p| p[1].data = p[1].data.slice(1..), "checksum");
        check(&mut assembler, |p| p.swap(0, 1), "part 1 of 2 where part 0 is expected");
        check(&mut assembler, |p| p[1].total = 3, "speaks of 3 parts");
        check(&mut assembler, |p| p.iter_mut().for_each(|p| p.total_bytes -= 1), "announced");
        check(&mut assembler, |p| p.iter_mut().for_each(|p| p.total_bytes += 1), "announced");
        check(&mut assembler, |p| p.iter_mut().for_each(|p| p.total = 0), "speaks of 0 parts");
    }
}
