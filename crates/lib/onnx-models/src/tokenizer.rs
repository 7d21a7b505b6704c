//! CLIP's byte-pair tokenizer, as OpenAI, open_clip and their descendants use it.

use instant_clip_tokenizer::Token;
use unicode_normalization::UnicodeNormalization;

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

    /// Ids of `text` with its marks, at most `most` of them (77 in all CLIP models; at least 3): of a text that is too long the
    /// last tokens are left out. Accents are composed first (NFC), as the vocabulary has them: some systems write them apart.
    pub fn encode(&self, text: &str, most: usize) -> Vec<i32> {
        let mut tokens = Vec::new();
        self.bpe.encode(&text.nfc().collect::<String>(), &mut tokens);
        let tokens = tokens.into_iter().take(most.saturating_sub(2)).map(|t: Token| i32::from(t.to_u16()));
        [Self::START].into_iter().chain(tokens).chain([Self::END]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_ids_of_openai_clip() {
        let t = Tokenizer::default();
        let ids = |s: &str| {
            let all = t.encode(s, 77);
            assert_eq!((all[0], all[all.len() - 1]), (Tokenizer::START, Tokenizer::END));
            all[1..all.len() - 1].to_vec()
        };
        assert_eq!(ids("a photo of a cat"), [320, 1125, 539, 320, 2368]);
        assert_eq!(ids("A  Photo of\na CAT"), [320, 1125, 539, 320, 2368]);
        assert_eq!(ids("a diagram"), [320, 22697]);
        assert_eq!(ids("hello world!"), [3306, 1002, 256]);
        assert_eq!(ids("Hi there"), [1883, 997]);
        assert!(ids("").is_empty());
        assert_eq!(ids("cafe\u{301}"), ids("caf\u{e9}"), "accents written apart");
    }

    #[test]
    fn long_texts_keep_their_end_mark() {
        let t = Tokenizer::default();
        let long = t.encode(&"cat ".repeat(200), 77);
        assert_eq!((long.len(), long[75], long[76]), (77, 2368, Tokenizer::END));
        assert_eq!(t.encode("cat", 5), [Tokenizer::START, 2368, Tokenizer::END]);
    }
}
