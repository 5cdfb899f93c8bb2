/* A driver in C with plain sockets, for a small computer without Zenoh and without libraries:
 *   cc -o gateway_driver gateway_driver.c && ./gateway_driver TOKEN [ROBOT [HOST [PORT]]]
 * It publishes odometry and a sighting at 10 Hz, and prints the pose once a second. */
#define _POSIX_C_SOURCE 200809L
#include <netdb.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static const char *token, *robot = "r1", *host = "127.0.0.1", *port = "8447";

static long long now_ns(void) {
  struct timespec t;
  clock_gettime(CLOCK_REALTIME, &t);
  return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static int dial(void) {
  struct addrinfo hints = {.ai_socktype = SOCK_STREAM}, *found;
  struct timeval patience = {.tv_sec = 5};
  if (getaddrinfo(host, port, &hints, &found)) return -1;
  int s = socket(found->ai_family, SOCK_STREAM, 0);
  if (s >= 0 && connect(s, found->ai_addr, found->ai_addrlen)) { close(s); s = -1; }
  if (s >= 0) setsockopt(s, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
  freeaddrinfo(found);
  return s;
}

/* Sends one request; the answer is in `answer`. Returns its status, or -1 without a gateway. */
static int request(const char *method, const char *path, const char *body, char *answer,
                   size_t size) {
  char text[2048];
  int status = -1, s = dial();
  int length = snprintf(text, sizeof text,
      "%s %s/%s%s HTTP/1.1\r\nHost: %s\r\nAuthorization: Bearer %s\r\nContent-Length: %zu\r\n"
      "Connection: close\r\n\r\n%s",
      method, strcmp(method, "GET") ? "/in" : "/pose", robot, path, host, token, strlen(body), body);
  answer[0] = 0;
  if (s < 0 || length >= (int)sizeof text || send(s, text, length, MSG_NOSIGNAL) != length) {
    fprintf(stderr, "no gateway at %s:%s\n", host, port);
  } else {
    size_t got = 0;
    ssize_t n;
    while (got < size - 1 && (n = read(s, answer + got, size - 1 - got)) > 0) got += n;
    answer[got] = 0;
    sscanf(answer, "HTTP/1.1 %d", &status);
  }
  if (s >= 0) close(s);
  const char *content = strstr(answer, "\r\n\r\n");
  memmove(answer, content ? content + 4 : "", content ? strlen(content + 4) + 1 : 1);
  if (status >= 400) fprintf(stderr, "%d %s\n", status, answer);
  return status;
}

int main(int count, char **words) {
  char body[512], answer[4096];
  const struct timespec tenth = {.tv_nsec = 100000000};
  if (count < 2) return fprintf(stderr, "%s TOKEN [ROBOT [HOST [PORT]]]\n", words[0]), 2;
  token = words[1];
  if (count > 2) robot = words[2];
  if (count > 3) host = words[3];
  if (count > 4) port = words[4];
  long long last = now_ns();
  for (int n = 1;; n++) {
    nanosleep(&tenth, NULL);
    long long stamp = now_ns();
    snprintf(body, sizeof body,
        "{\"from_ns\": %lld, \"stamp_ns\": %lld, \"distance_m\": %.6f, \"turn_rad\": %.6f}",
        last, stamp, 0.02, 0.0);
    request("POST", "/odometry", body, answer, sizeof answer);
    snprintf(body, sizeof body,
        "{\"stamp_ns\": %lld, \"sightings\": [{\"id\": \"door\", \"range_m\": %.4f,"
        " \"bearing_rad\": %.4f}]}", stamp, 2.0, 0.1);
    request("POST", "/sightings", body, answer, sizeof answer);
    if (n % 10 == 0 && request("GET", "", "", answer, sizeof answer) == 200) {
      puts(answer);
      fflush(stdout);
    }
    last = stamp;
  }
}
