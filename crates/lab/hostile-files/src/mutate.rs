//! Damage to good files, from a seed.

/// SplitMix64: enough for damage, and the same everywhere.
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> u64 {
        let drawn = gs_io::mixed(self.0);
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        drawn
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() % n.max(1) as u64) as usize
    }

    fn text(&mut self) -> &'static str {
        TEXT.split('|').nth(self.below(20)).unwrap_or_default()
    }

    fn of<'a, T>(&mut self, all: &'a [T]) -> &'a T {
        &all[self.below(all.len())]
    }
}

const NAN: u64 = f64::NAN.to_bits();
const INFINITE: u64 = f64::INFINITY.to_bits();
/// Two numbers of single precision that are none.
const NANS: u64 = 0x7fc0_0000_7fc0_0000;
/// Numbers that lie, as the formats' own integers and floats.
const WORDS: [u64; 10] = [0, 1, 0xff, 0xffff, 1 << 31, 1 << 40, u64::MAX, NAN, INFINITE, NANS];
/// Words that lie or break the syntax, apart by `|`.
const TEXT: &str = "-|9|99999999999|18446744073709551615|nan|-Infinity|1e308| |\n|\r|\"|[|{|]|}|../../x|/etc/x|\\|\0|é";

/// A damaged copy of `good`: cut, flipped, spliced with itself or `other`, or with a number that lies. Equal seeds do equal
/// damage.
pub fn mutate(good: &[u8], other: &[u8], seed: u64) -> Vec<u8> {
    let mut dice = Dice(seed);
    let mut bytes = good.to_vec();
    for _ in 0..1 + dice.below(3) {
        let n = bytes.len();
        let at = dice.below(n);
        match dice.below(9) {
            0 => bytes.truncate(at),
            1 | 2 if n > 0 => bytes[at] ^= 1 << dice.below(8),
            3 if n > 0 => bytes[at] = dice.next() as u8,
            4 => {
                let word = dice.of(&WORDS).to_le_bytes();
                let size = *dice.of(&[4usize, 8]);
                bytes.iter_mut().skip(at).zip(&word[..size]).for_each(|(b, w)| *b = *w);
            }
            5 => {
                // A number in a text becomes another.
                let digit = bytes.iter().skip(at).position(u8::is_ascii_digit).map(|p| p + at);
                let start = digit.unwrap_or(at);
                let end = start + bytes[start.min(n)..].iter().take_while(|b| b.is_ascii_digit()).count();
                bytes.splice(start.min(n)..end.min(n), dice.text().bytes());
            }
            6 => _ = bytes.splice(at..at, dice.text().bytes()),
            7 => {
                let from = if dice.below(2) == 0 { good } else { other };
                let start = dice.below(from.len());
                let length = dice.below((from.len() - start).min(4096) + 1);
                bytes.splice(at..at, from[start..start + length].iter().copied());
            }
            _ => _ = bytes.drain(at..(at + dice.below(64)).min(n)),
        }
    }
    bytes
}
