//! CLIP's byte-pair tokenizer, as OpenAI, open_clip and their descendants use it.

use instant_clip_tokenizer::Token;

/// Turns text into token ids: start mark, tokens of the lower-cased text, end mark, padding. Building its bundled
/// vocabulary of 49,408 tokens takes some tens of milliseconds: keep it.
#[derive(Default)]
pub struct Tokenizer {
    bpe: instant_clip_tokenizer::Tokenizer,
}

impl Tokenizer {
    /// Id that begins every text.
    pub const START: i32 = 49406;
    /// Id that ends every text; the largest, by which text encoders find the end.
    pub const END: i32 = 49407;

    /// Ids of `text`, exactly `length` of them (77 in all CLIP models; at least 3). A text that is too long is cut so
    /// that the end mark stays; a short one is filled with `pad`.
    pub fn encode(&self, text: &str, length: usize, pad: i32) -> Vec<i32> {
        let mut tokens = Vec::new();
        self.bpe.encode(text, &mut tokens);
        let tokens = tokens.into_iter().take(length.saturating_sub(2)).map(|t: Token| i32::from(t.to_u16()));
        let mut ids: Vec<i32> = [Self::START].into_iter().chain(tokens).chain([Self::END]).collect();
        ids.resize(length, pad);
        ids
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_ids_of_openai_clip() {
        let t = Tokenizer::default();
        let ids = |s: &str| {
            let all = t.encode(s, 77, 0);
            assert_eq!(all.len(), 77);
            let end = all.iter().position(|&i| i == Tokenizer::END).unwrap();
            assert!(all[end + 1..].iter().all(|&i| i == 0));
            assert_eq!(all[0], Tokenizer::START);
            all[1..end].to_vec()
        };
        assert_eq!(ids("a photo of a cat"), [320, 1125, 539, 320, 2368]);
        assert_eq!(ids("A  Photo of\na CAT"), [320, 1125, 539, 320, 2368]);
        assert_eq!(ids("a diagram"), [320, 22697]);
        assert_eq!(ids("hello world!"), [3306, 1002, 256]);
        assert_eq!(ids("Hi there"), [1883, 997]);
        assert!(ids("").is_empty());
    }

    #[test]
    fn long_texts_keep_their_end_mark_and_padding_is_free() {
        let t = Tokenizer::default();
        let long = t.encode(&"cat ".repeat(200), 77, 0);
        assert_eq!((long.len(), long[75], long[76]), (77, 2368, Tokenizer::END));
        assert_eq!(t.encode("cat", 5, 7), [Tokenizer::START, 2368, Tokenizer::END, 7, 7]);
    }
}
